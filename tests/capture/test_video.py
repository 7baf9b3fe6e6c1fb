from __future__ import annotations

import os
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_captures import truncate
from videos import SIZE, number_of, write_video

from freeocc3d.capture import Options, open_capture, read_ahead
from freeocc3d.capture.cameras.camera_files import DIAGONAL_35MM, USUAL_FOCAL
from freeocc3d.capture.videos import video_process
from freeocc3d.capture.videos.video_decoding import VideoDecoder
from freeocc3d.core.errors import CaptureError, ConfigError, FrameError

OPEN = "open-gop=1:b-pyramid=normal:bframes=3:b-adapt=0"
VARIABLE_MS = np.cumsum([0] + [20 + 13 * (n % 4) + 100 * (n == 30) for n in range(59)]).tolist()


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("scan.mp4", "libx264"),
        ("scan.mov", "libx265"),
        ("scan.mkv", "libx264"),
        ("scan.webm", "libvpx-vp9"),
        ("scan.avi", "mpeg4"),
        ("scan.avi", "mjpeg"),
        ("scan.avi", "libx264"),
        ("scan.mpg", "mpeg2video"),
        ("scan.h264", "libx264"),
        ("scan.hevc", "libx265"),
        ("scan", "libx264"),
        ("scan.ts", "libx264"),
    ],
)
def test_every_frame_is_the_one_of_its_index_in_any_order(tmp_path: Path, name: str, codec: str) -> None:
    capture = open_capture(write_video(tmp_path / name, codec=codec))
    assert capture.format == "video"
    assert len(capture) == 60
    np.testing.assert_allclose(np.diff(capture.timestamps), 1 / 30, atol=2e-3)
    order = np.random.default_rng(0).permutation(60).tolist()
    for index in [*range(60), *range(0, 60, 7), *order]:
        frame = capture[index]
        assert (frame.index, number_of(frame.color)) == (index, index)
        assert frame.timestamp == capture.timestamps[index]
    assert not frame.depth_m.any()
    assert frame.depth_m.shape == frame.color.shape[:2]
    assert not capture.has_depth
    assert capture.raw_depth(0) is None


@pytest.mark.parametrize(("codec", "options"), [("mpeg4", {"bf": "2"}), ("libx264", {"bf": "3", "x264-params": OPEN})])
@pytest.mark.parametrize("suffix", ["avi", "mkv"])
def test_frames_that_are_decoded_in_another_order_have_the_index_of_their_display(
    tmp_path: Path, codec: str, options: dict[str, str], suffix: str
) -> None:
    capture = open_capture(write_video(tmp_path / f"scan.{suffix}", codec=codec, options=options))
    np.testing.assert_allclose(np.diff(capture.timestamps), 1 / 30, atol=2e-3)
    for index in [*range(60), 7, 3, 40, 39]:
        assert number_of(capture[index].color) == index


def test_a_raw_stream_without_a_rate_counts_its_frames(tmp_path: Path) -> None:
    options = {"x265-params": "vui-timing-info=0:log-level=none"}
    path = write_video(tmp_path / "scan.265", codec="libx265", options=options, form="hevc")
    capture = open_capture(path)
    np.testing.assert_array_equal(np.diff(capture.timestamps), np.diff(capture.timestamps)[0])
    assert number_of(capture[59].color) == 59
    truncate(path)
    assert number_of(open_capture(path)[20].color) == 20


def test_times_of_a_variable_rate_are_the_files_own(tmp_path: Path) -> None:
    capture = open_capture(write_video(tmp_path / "scan.mp4", times_ms=VARIABLE_MS))
    np.testing.assert_allclose(capture.timestamps, np.array(VARIABLE_MS) / 1000, atol=1e-4)
    assert [number_of(capture[index].color) for index in (31, 5, 30)] == [31, 5, 30]


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
def test_a_stated_rotation_is_applied(tmp_path: Path, rotation: int) -> None:
    path = write_video(tmp_path / "scan.mp4", rotation=rotation)
    capture = open_capture(path)
    frame = capture[37]
    assert frame.color.shape == (SIZE[1], SIZE[0], 3)
    assert number_of(frame.color) == 37
    assert (frame.intrinsics.width, frame.intrinsics.height) == SIZE
    video = cv2.VideoCapture(str(path))
    expected = video.read()[1][..., ::-1]
    np.testing.assert_allclose(capture[0].color.astype(int), expected.astype(int), atol=12)


def test_large_frames_are_reduced_with_their_camera(tmp_path: Path) -> None:
    path = write_video(tmp_path / "scan.mp4", size=(192, 128))
    whole = open_capture(path, Options(intrinsics=(150.0, 151.0, 90.0, 60.0)))[9]
    small = open_capture(path, Options(intrinsics=(150.0, 151.0, 90.0, 60.0), max_size=96))[9]
    assert whole.color.shape == (128, 192, 3)
    assert small.intrinsics == whole.intrinsics.resized(96, 64)
    expected = cv2.resize(whole.color, (96, 64), interpolation=cv2.INTER_AREA)
    assert np.abs(small.color.astype(int) - expected).mean() < 3


def test_an_unknown_camera_is_a_guess_and_a_given_one_is_known(tmp_path: Path) -> None:
    path = write_video(tmp_path / "scan.mp4")
    capture = open_capture(path)
    assert not capture.intrinsics_known
    assert not capture.focal_stated
    assert capture[0].intrinsics.fx == pytest.approx(USUAL_FOCAL * SIZE[0])
    assert open_capture(path, Options(intrinsics=(80.0, 80.0, 48.0, 32.0))).intrinsics_known


def test_the_lens_that_a_phone_states_gives_the_focal_length(tmp_path: Path) -> None:
    tags = {"com.apple.quicktime.camera.focal_length.35mm_equivalent": "26"}
    capture = open_capture(write_video(tmp_path / "scan.mp4", tags=tags))
    assert capture.focal_stated
    assert not capture.intrinsics_known
    assert capture[0].intrinsics.fx == pytest.approx(26 / DIAGONAL_35MM * np.hypot(*SIZE))


def test_threads_may_read_at_once(tmp_path: Path) -> None:
    capture = open_capture(write_video(tmp_path / "scan.mp4"))
    order = np.random.default_rng(1).permutation(60).tolist()
    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(lambda index: number_of(capture[index].color), order)) == order


def test_ascending_reading_decodes_each_frame_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoder = VideoDecoder(write_video(tmp_path / "scan.mp4"))
    seeks = []
    seek = decoder._seek
    monkeypatch.setattr(decoder, "_seek", lambda start: (seeks.append(start), seek(start)))
    read = [number_of(decoder.image(index, (96, 64))) for index in range(0, 60, 5)]
    assert read == list(range(0, 60, 5))
    assert len(seeks) <= 5, "one for each group of pictures at the most"


def test_what_is_no_video_is_reported_in_a_sentence(tmp_path: Path) -> None:
    notes = tmp_path / "notes.mp4"
    notes.write_text("no video at all\n" * 50)
    with pytest.raises(CaptureError, match=r"notes\.mp4 is a text file, not a readable video"):
        open_capture(notes)
    (tmp_path / "empty.mp4").touch()
    with pytest.raises(CaptureError, match=r"empty\.mp4: it is empty"):
        open_capture(tmp_path / "empty.mp4")
    cut = write_video(tmp_path / "cut.mp4")  # its list of frames, which mp4 has at the end, is lost
    truncate(cut)
    with pytest.raises(CaptureError, match=r"cut\.mp4 is not a readable video"):
        open_capture(cut)
    with pytest.raises(CaptureError, match=r"one\.mp4 is not a usable video: it holds 1 frame\. Is it cut off"):
        open_capture(write_video(tmp_path / "one.mp4", count=1))


def test_a_video_that_is_cut_off_gives_what_is_there(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cut.mkv")
    truncate(path, 0.6)
    capture = open_capture(path)
    assert 10 < len(capture) < 60
    shown = [
        number_of(frame.color)
        for _, frame in read_ahead(capture, range(len(capture) - 2))
        if not isinstance(frame, FrameError)
    ]
    assert shown == list(range(len(capture) - 2))


def test_damaged_frames_are_reported_and_the_others_read(tmp_path: Path) -> None:
    path = write_video(tmp_path / "scan.avi", codec="mjpeg")
    data = bytearray(path.read_bytes())
    at = [n for n in range(len(data) - 1) if data[n : n + 2] == b"\xff\xd8"][20]
    data[at : at + 700] = bytes(700)
    path.write_bytes(bytes(data))
    capture = open_capture(path)
    with pytest.raises(FrameError, match=r"Frame 20 of .*scan\.avi"):
        capture[20]
    assert [number_of(capture[index].color) for index in (21, 19, 22)] == [21, 19, 22]


def test_a_file_is_only_read_as_a_video_and_a_folder_never(tmp_path: Path) -> None:
    path = write_video(tmp_path / "scan.mp4", count=3)
    with pytest.raises(CaptureError, match=r"scan\.mp4 is a file, but capture\.format=replica"):
        open_capture(path, Options(format="replica"))
    with pytest.raises(CaptureError, match=r"is a folder, but capture\.format=video"):
        open_capture(tmp_path, Options(format="video"))
    with pytest.raises(CaptureError, match=r"but .*scan\.mp4 may be: give that file"):
        open_capture(tmp_path)
    with pytest.raises(ConfigError, match="'max_size' must be from 16 to"):
        open_capture(path, Options(max_size=2))
    with pytest.raises(ConfigError, match="'scale' must be"):
        open_capture(path, Options(scale=0.0))


def test_damage_costs_the_frames_that_hang_on_it_alone(tmp_path: Path) -> None:
    path = write_video(tmp_path / "scan.mp4")
    data = bytearray(path.read_bytes())
    start = data.find(b"mdat") + 4
    at = data.find(b"\x00\x00\x00", start + 900)  # a later frame's length
    data[at + 5 : at + 60] = bytes(55)
    path.write_bytes(bytes(data))
    capture = open_capture(path)
    shown, broken = {}, []
    for index, frame in read_ahead(capture, range(len(capture))):
        if isinstance(frame, FrameError):
            broken.append(index)
        else:
            shown[index] = number_of(frame.color)
    assert len(shown) + len(broken) == 60
    assert len(shown) >= 40
    assert sum(number != index for index, number in shown.items()) <= 12, "concealed, within one group of pictures"


@pytest.mark.parametrize("name", ["poses.txt", "scan.mp4", "list.m3u8", "list.ffconcat"])
def test_text_is_no_video(tmp_path: Path, name: str) -> None:
    """FFmpeg draws text, and opens the files that a list names."""
    write_video(tmp_path / "other.mkv", count=5)
    for text in (
        "0.1 1 2 3 0 0 0 1\n" * 200,
        "#EXTM3U\n#EXTINF:1,\nother.mkv\n",
        "ffconcat version 1.0\nfile other.mkv\n",
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(CaptureError, match=rf"{name} is a text file, not a readable video"):
            open_capture(tmp_path / name)


@pytest.mark.parametrize(
    "text",
    ["#EXTM3U\n#EXTINF:1,\nother.mkv\n\0", "ffconcat version 1.0\nfile other.mkv\n#\0\n", "\0text " * 900],
)
def test_formats_that_open_other_files_or_draw_text_are_refused(tmp_path: Path, text: str) -> None:
    write_video(tmp_path / "other.mkv", count=5)
    (tmp_path / "scan.mp4").write_text(text)
    with pytest.raises(CaptureError, match=r"scan\.mp4 is not a readable video"):
        open_capture(tmp_path / "scan.mp4")


@pytest.mark.parametrize("target", ["pipe", "/dev/zero", "loop"])
def test_what_is_no_regular_file_is_refused(tmp_path: Path, target: str) -> None:
    path = tmp_path / "scan.mp4"
    if target == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(path if target == "loop" else target)
    with pytest.raises(CaptureError, match=r"scan\.mp4"):
        open_capture(path)
    with pytest.raises(CaptureError, match=r"Cannot read .*scan\.mp4"):
        VideoDecoder(path)


def test_a_decoder_that_dies_costs_its_frame_alone(tmp_path: Path) -> None:
    capture = open_capture(write_video(tmp_path / "scan.mp4", count=20))
    assert number_of(capture[3].color) == 3
    decoder = capture._decoder  # type: ignore[attr-defined]
    for again in range(5):
        if decoder._process is not None:
            decoder._process.kill()
        with pytest.raises(FrameError, match=r"Frame 4 of .*scan\.mp4 cannot be decoded: the decoder has ended"):
            capture[4]
        if again < 3:
            assert number_of(capture[5].color) == 5
    with pytest.raises(FrameError, match="too often"):
        capture[6]


def test_a_decoder_that_makes_no_progress_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = open_capture(write_video(tmp_path / "scan.mp4", count=20))
    process = capture._decoder._process  # type: ignore[attr-defined]
    process.send_signal(signal.SIGSTOP)
    monkeypatch.setattr(video_process, "SILENT_S", 0.2)
    with pytest.raises(FrameError, match="makes no progress"):
        capture[1]
    assert process.poll() is not None


def test_memory_of_the_decoder_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taking = "v.VideoDecoder = lambda *_, **more: bytearray(8 << 30)"
    code = f"from freeocc3d.capture.videos import video_decoding as v; {taking}; v.main()"
    monkeypatch.setattr(video_process, "_CODE", code)
    with pytest.raises(CaptureError, match="needs too much memory"):
        open_capture(write_video(tmp_path / "scan.mp4", count=3))


def test_a_decoder_that_aborts_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video_process, "_CODE", "import os; os.abort()")
    with pytest.raises(CaptureError, match=r"scan\.mp4 is not a readable video: the decoder has ended \(signal 6\)"):
        open_capture(write_video(tmp_path / "scan.mp4", count=3))
