"""Recordings of an Azure Kinect: their images, their cameras, and files that are none."""

from __future__ import annotations

import copy
import json
import struct
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from azure_kinect_files import CALIBRATION, element, write_recording
from numpy.typing import NDArray
from ros_bags import encode
from small_captures import color_image, truncate

from freeocc3d.capture.base import Options
from freeocc3d.capture.cameras.azure_kinect_cameras import read_calibration
from freeocc3d.capture.opening import open_capture
from freeocc3d.capture.readers.azure_kinect import Reader
from freeocc3d.core.errors import CaptureError, FrameError

COLOR_SIZE, DEPTH_SIZE = (1280, 720), (320, 288)
TRACKS = [("COLOR", "MJPG", COLOR_SIZE), ("DEPTH", "b16g", DEPTH_SIZE), ("IR", "b16g", DEPTH_SIZE)]
COUNT = 3


def depth(index: int) -> NDArray[np.uint16]:
    """A wall 2 m away, a centimeter farther in each frame, with a patch in front of it."""
    image = np.full(DEPTH_SIZE[::-1], 2000 + 10 * index, np.uint16)
    image[100:140, 150:200] = 1000
    return image


def jpeg(index: int) -> bytes:
    return encode(color_image(index, COLOR_SIZE), ".jpg")


def blocks() -> list[tuple[float, int, bytes]]:
    found = []
    for index in range(COUNT):
        at = 0.5 + index / 30
        found += [(at, 0, jpeg(index)), (at + 0.001, 1, depth(index).astype(">u2").tobytes())]
        found.append((at + 0.001, 2, bytes(2 * DEPTH_SIZE[0] * DEPTH_SIZE[1])))
    return found


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "scan.mkv", TRACKS, blocks())


def test_images_are_what_was_recorded(recording: Path) -> None:
    capture = open_capture(recording)
    assert isinstance(capture, Reader)
    assert (len(capture), capture.has_depth, capture.intrinsics_known) == (COUNT, True, True)
    np.testing.assert_allclose(capture.timestamps, 0.5 + np.arange(COUNT) / 30, atol=1e-6)
    for index in (2, 0, 1):
        expected = cv2.imdecode(np.frombuffer(jpeg(index), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        np.testing.assert_array_equal(capture.stored_color(index), expected)
        np.testing.assert_array_equal(capture.stored_depth(index), depth(index))
    frame = capture[1]
    assert (
        frame.color.shape[:2] == frame.depth_m.shape == (288, 320)[:2] or frame.color.shape[:2] == frame.depth_m.shape
    )
    assert np.median(frame.depth_m[frame.depth_m > 1.5]) == pytest.approx(2.01, abs=0.3)


def test_ffmpeg_sees_the_same_file(recording: Path) -> None:
    """The file of this test is a Matroska file that others read."""
    import av

    with av.open(str(recording)) as container:
        assert container.streams.video[0].codec_context.name == "mjpeg"
        assert len(container.streams.video) == 3
        frames = list(container.decode(container.streams.video[0]))
    assert [frame.width for frame in frames] == [1280] * COUNT
    assert frames[0].time == pytest.approx(0.5)


def test_depth_lands_where_the_color_camera_sees_it(recording: Path) -> None:
    """Against OpenCV's own projection with the distortion of both lenses."""
    capture = Reader(recording, Options())
    rig = capture.rig(0)
    assert rig.T_color_depth is not None
    pixels = np.array([(175.0, 120.0), (160.0, 110.0), (190.0, 130.0)])
    rays = cv2.undistortPoints(pixels[:, None], rig.depth.camera.matrix, np.array(rig.depth.distortion))[:, 0]
    points = np.column_stack((rays, np.ones(3)))  # at 1 m
    T = np.array(rig.T_color_depth)
    in_color = points @ T[:3, :3].T + T[:3, 3]
    K = capture[0].intrinsics
    at = np.rint(
        np.column_stack((K.fx * in_color[:, 0], K.fy * in_color[:, 1])) / in_color[:, 2:] + (K.cx, K.cy)
    ).astype(int)
    np.testing.assert_allclose(capture[0].depth_m[at[:, 1], at[:, 0]], in_color[:, 2], atol=0.01)


def cameras(color: tuple[int, int], depth_size: tuple[int, int], stated: Any = CALIBRATION) -> Any:
    return read_calibration(json.dumps(stated).encode() + b"\0", color, depth_size, "scan.mkv")


def values(camera: Any) -> tuple[float, ...]:
    return camera.fx, camera.fy, camera.cx, camera.cy


def test_cameras_are_those_that_microsofts_library_states() -> None:
    """Numbers of a real device: its raw calibration, and what the library made of it for NFOV unbinned and 1080p."""
    stated = cameras((1920, 1080), (640, 576))
    assert values(stated.depth.camera) == pytest.approx((503.927643, 503.978729, 332.064270, 325.880615), abs=1e-3)
    assert values(stated.color.camera) == pytest.approx((904.141541, 903.521362, 953.284424, 555.142456), abs=1e-3)
    assert stated.depth.distortion == pytest.approx(
        (3.130577, 2.324939, 0.000081, -0.000051, 0.130416, 3.458652, 3.350115, 0.662942), abs=1e-6
    )
    assert stated.T_color_depth[:3, 3] == pytest.approx((-0.03207, -0.00208, 0.00387), abs=1e-5)


@pytest.mark.parametrize(("size", "scale"), [((320, 288), 0.5), ((640, 576), 1), ((512, 512), 0.5), ((1024, 1024), 1)])
def test_depth_modes_are_parts_of_one_sensor(size: tuple[int, int], scale: float) -> None:
    """The middle of a mode's images lies at one place of the sensor, for narrow and wide ones."""
    camera = cameras((1280, 720), size).depth.camera
    assert camera.fx == pytest.approx(503.9276 * scale, abs=1e-3)
    corner = np.array((192, 180)) * scale if size[0] in (320, 640) else np.zeros(2)
    on_sensor = (np.array((camera.cx, camera.cy)) + 0.5 + corner) / scale
    np.testing.assert_allclose(on_sensor, (524.5643, 506.3806), atol=1e-3)


@pytest.mark.parametrize("size", [(1280, 720), (1920, 1080), (2560, 1440), (2048, 1536), (3840, 2160), (4096, 3072)])
def test_color_modes_share_a_view(size: tuple[int, int]) -> None:
    camera = cameras(size, (640, 576)).color.camera
    assert camera.fx / size[0] == pytest.approx(0.470907, abs=1e-6)
    assert (camera.cy + 0.5 - size[1] / 2) / size[0] == pytest.approx((0.5108628 - 0.5) * 0.75, abs=1e-6)


def test_a_calibration_of_older_devices_is_for_16_to_9() -> None:
    old = copy.deepcopy(CALIBRATION)
    camera = old["CalibrationInformation"]["Cameras"][1]
    camera["SensorHeight"] = 2304
    parameters = camera["Intrinsics"]["ModelParameters"]
    parameters[1], parameters[3] = (parameters[1] * 3072 - 384) / 2304, parameters[3] * 3072 / 2304
    assert values(cameras((1920, 1080), (640, 576), old).color.camera) == pytest.approx(
        values(cameras((1920, 1080), (640, 576)).color.camera)
    )


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (lambda c: c["Intrinsics"].update(ModelType="CALIBRATION_LensDistortionModelTheta"), "ModelTheta"),
        (lambda c: c["Intrinsics"].update(ModelParameters=[1, 2]), "not usable"),
        (lambda c: c["Intrinsics"]["ModelParameters"].__setitem__(2, 0), "unusable intrinsics"),
        (lambda c: c["Rt"].update(Rotation=[0] * 9), "no rigid transform"),
        (lambda c: c.update(Location="elsewhere"), "lacks the camera"),
        (lambda c: c.update(SensorWidth=1000), "a sensor of 1000 x 3072"),
    ],
)
def test_impossible_calibrations_are_refused(changed: Any, said: str) -> None:
    stated = copy.deepcopy(CALIBRATION)
    changed(stated["CalibrationInformation"]["Cameras"][1])
    with pytest.raises(CaptureError, match=said):
        cameras((1280, 720), (640, 576), stated)


@pytest.mark.parametrize("fourcc", ["NV12", "YUY2"])
def test_raw_color(fourcc: str, tmp_path: Path) -> None:
    """Gray of 123 in limited range is 16 + 123 * 219 / 255 = 122."""
    width, height = COLOR_SIZE
    half = np.full(width * height // 2, 128, np.uint8)
    gray = np.full(width * height, 122, np.uint8)
    data = np.concatenate((gray, half)) if fourcc == "NV12" else np.column_stack((gray, np.tile(half, 2)))
    sent = [(at, row, data.tobytes() if row == 0 else old) for at, row, old in blocks()]
    path = write_recording(tmp_path / "scan.mkv", [("COLOR", fourcc, COLOR_SIZE), *TRACKS[1:]], sent)
    assert np.abs(Reader(path, Options()).stored_color(0).astype(int) - 123).max() <= 2


def test_color_alone(recording: Path) -> None:
    capture = Reader(recording, Options(depth=False))
    assert not capture.has_depth
    assert capture[0].color.shape == (720, 1280, 3)
    assert not capture[0].depth_m.any()


def test_tracks_are_found_by_their_names_without_tags(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "scan.mkv", TRACKS, blocks(), tags={})
    assert len(Reader(path, Options())) == COUNT


def test_a_recording_that_was_stopped_by_force(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "scan.mkv", TRACKS, blocks(), unknown_sizes=True)
    assert len(Reader(path, Options())) == COUNT
    truncate(path, 0.8)
    capture = Reader(path, Options())
    assert 1 <= len(capture) < COUNT
    np.testing.assert_array_equal(capture.stored_depth(0), depth(0))


def test_a_recording_that_is_cut_off_is_told(recording: Path) -> None:
    assert open_capture(recording).warnings == ()
    data = recording.read_bytes()
    recording.write_bytes(data[: len(data) * 2 // 3])
    capture = open_capture(recording)
    assert 0 < len(capture) < COUNT
    assert f"scan.mkv is cut off: the {len(capture)} frames" in capture.warnings[0].text


def test_images_without_a_partner_are_counted(tmp_path: Path) -> None:
    sent = [block for block in blocks() if not (block[1] == 1 and block[0] < 0.52)]
    capture = Reader(write_recording(tmp_path / "scan.mkv", TRACKS, sent), Options())
    assert len(capture) == COUNT - 1
    assert [notice.code for notice in capture.warnings] == ["images-left-out"]


@pytest.mark.parametrize(
    ("tracks", "said"),
    [
        (TRACKS[:1], "no track of depth images: map color only"),
        (TRACKS[1:], "no track of color images"),
        ([TRACKS[0], ("DEPTH", "HEVC", DEPTH_SIZE)], "holds depth as HEVC, which is not read"),
        ([TRACKS[0], ("DEPTH", "b16g", (300, 200))], "depth of 300 x 200 pixels, which no mode"),
        ([("COLOR", "MJPG", (1 << 20, 1 << 20)), TRACKS[1]], "not possible"),
    ],
)
def test_other_recordings_are_refused(tracks: Any, said: str, tmp_path: Path) -> None:
    sent = [block for block in blocks() if block[1] < len(tracks)]
    with pytest.raises(CaptureError, match=said):
        Reader(write_recording(tmp_path / "scan.mkv", tracks, sent), Options())


def test_a_recording_without_calibration_names_what_it_lacks(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "scan.mkv", TRACKS, blocks(), calibration=None)
    with pytest.raises(CaptureError, match=r"lacks the attachment calibration\.json"):
        Reader(path, Options())


def test_a_damaged_image_breaks_its_frame_only(tmp_path: Path) -> None:
    sent = blocks()
    sent[3] = (sent[3][0], 0, b"no image")
    sent[7] = (*sent[7][:2], b"short")
    capture = Reader(write_recording(tmp_path / "scan.mkv", TRACKS, sent), Options())
    capture[0]
    with pytest.raises(FrameError, match=r"Image 1 of the track COLOR in .*scan\.mkv"):
        capture[1]
    with pytest.raises(FrameError, match="cut off: it has 5 bytes for 320 x 288"):
        capture[2]


def test_damage_anywhere_ends_in_a_sentence(recording: Path) -> None:
    whole = recording.read_bytes()
    rng = np.random.default_rng(0)
    for trial in range(45):
        damaged = np.frombuffer(whole, np.uint8).copy()
        at = rng.integers(0, 6000 if trial % 2 else len(whole), 8)
        damaged[at] = rng.integers(0, 256, 8)
        recording.write_bytes(damaged.tobytes() if trial % 3 else damaged.tobytes()[: rng.integers(0, len(whole))])
        Reader.recognizes(recording)
        said = []
        try:
            capture = Reader(recording, Options())
            for index in range(min(len(capture), 1)):
                try:
                    capture[index]
                except FrameError as error:
                    said.append(str(error))
        except CaptureError as error:
            said.append(str(error))
        assert all(str(recording) in sentence for sentence in said)


def test_what_is_no_recording_is_not_recognized(tmp_path: Path) -> None:
    (tmp_path / "folder.mkv").mkdir()
    (tmp_path / "empty.mkv").write_bytes(b"")
    (tmp_path / "start.mkv").write_bytes(element(0x1A45DFA3, b""))
    video = write_recording(tmp_path / "video.mkv", TRACKS[:1], blocks()[:1])
    for path in (*tmp_path.iterdir(), tmp_path / "missing.mkv", video):
        assert not Reader.recognizes(path)
    with pytest.raises(CaptureError, match="is no Matroska file"):
        Reader(tmp_path / "empty.mkv", Options())


def test_opening_many_frames_is_fast(tmp_path: Path) -> None:
    tiny = struct.pack(">H", 1000)
    sent = []
    for index in range(10_000):
        sent += [(index / 30, row, tiny) for row in range(3)]
    path = write_recording(tmp_path / "scan.mkv", TRACKS, sent)
    start = time.process_time()
    assert len(Reader(path, Options())) == 10_000
    assert time.process_time() - start < 10, "a millisecond a frame"
