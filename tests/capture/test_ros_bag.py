"""ROS bags become frames: color and depth as they were sent, with their times and cameras."""

from __future__ import annotations

import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import NDArray
from ros_bags import COLOR, DEPTH, START_S, Kind, Messages, Sent, encode, stored_file, write_bag
from small_captures import SIZE, color_image, data_folder, depth_image

from freeocc3d.capture.base import Options
from freeocc3d.capture.opening import open_capture
from freeocc3d.capture.readers import ros_bag
from freeocc3d.capture.readers.ros_bag import Reader
from freeocc3d.core.errors import CaptureError, FrameError

KINDS: tuple[Kind, ...] = ("bag", "db3", "mcap")
K = 40.0, 41.0, 15.5, 11.5
INFO = "/camera/color/camera_info"
COUNT = 4


def second(index: int) -> float:
    """When frame ``index`` was taken. Recording it took some milliseconds."""
    return START_S + 0.1 * index


def scan(messages: Messages, color_topic: str = COLOR, depth_topic: str = DEPTH) -> list[Sent]:
    """Raw color and depth of one camera."""
    sent: list[Sent] = [(INFO, round(second(0) * 1e9), messages.info(SIZE, K))]
    for index in range(COUNT):
        at = round(second(index) * 1e9) + 5_000_000
        sent.append((color_topic, at, messages.image(color_image(index), "rgb8", second(index))))
        sent.append((depth_topic, at + 1, messages.image(depth_image(index), "16UC1", second(index) + 0.002)))
    return sent


def open_bag(path: Path, **options: Any) -> Reader:
    return Reader(path, Options(**options))


def test_frames_of_packed_chunks_are_what_was_sent(tmp_path: Path) -> None:
    messages = Messages("bag")
    capture = open_bag(write_bag(tmp_path / "scan", messages, scan(messages), "bz2"))
    assert len(capture) == COUNT
    np.testing.assert_allclose(capture.timestamps, [second(index) for index in range(COUNT)], atol=1e-6)
    assert capture.intrinsics_known
    assert capture.warnings == ()
    for index in (3, 0, 2, 1):
        frame = capture[index]
        np.testing.assert_array_equal(frame.color, color_image(index))
        np.testing.assert_allclose(frame.depth_m, depth_image(index) / 1000, atol=1e-6)
        assert (frame.intrinsics.fx, frame.intrinsics.cy) == (K[0], K[3])


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_file_alone_is_read_as_its_folder(kind: Kind, tmp_path: Path) -> None:
    messages = Messages(kind)
    file = stored_file(write_bag(tmp_path / "scan", messages, scan(messages)))
    assert Reader.recognizes(file)
    np.testing.assert_array_equal(open_bag(file)[1].color, color_image(1))
    assert len(open_capture(file)) == COUNT
    (file.parent / "metadata.yaml").unlink()
    assert len(open_capture(file.parent)) == COUNT
    (file.parent / "color").mkdir()
    assert not Reader.recognizes(file.parent)  # images that were taken from it


@pytest.mark.parametrize(
    "written",
    [
        {"use_chunking": False},
        {"use_chunking": False, "index_types": IndexType.NONE, "repeat_channels": False, "use_statistics": False},
        {"index_types": IndexType.NONE, "repeat_channels": False, "compression": CompressionType.LZ4},
        {"index_types": IndexType.CHUNK, "compression": CompressionType.ZSTD, "chunk_size": 5000},
        {"compression": CompressionType.NONE, "chunk_size": 5000, "repeat_channels": False},
    ],
)
def test_mcap_files_of_other_writers(written: dict[str, Any], tmp_path: Path) -> None:
    """Without chunks, index, or a summary of the channels, as fast recorders write them."""
    messages = Messages("mcap")
    file = stored_file(write_bag(tmp_path / "scan", messages, scan(messages)))
    with file.open("rb") as read, (tmp_path / "again.mcap").open("wb") as stream:
        writer = Writer(stream, **written)
        writer.start("ros2", "test")
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(read).iter_messages():
            assert schema is not None
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.log_time)
        writer.finish()
    capture = open_bag(tmp_path / "again.mcap")
    assert len(capture) == COUNT
    for index in (2, 0, 3):
        np.testing.assert_array_equal(capture[index].color, color_image(index))


def test_a_folder_of_several_files_is_one_scan(tmp_path: Path) -> None:
    messages = Messages("mcap")
    sent = scan(messages)
    parts = [stored_file(write_bag(tmp_path / f"p{n}", messages, part)) for n, part in enumerate((sent[:5], sent[5:]))]
    (tmp_path / "scan").mkdir()
    for number, part in enumerate(parts):
        part.rename(tmp_path / "scan" / f"scan_{number}.mcap")
    capture = open_capture(tmp_path / "scan")
    assert capture.format == "ros_bag"
    assert len(capture) == COUNT
    np.testing.assert_array_equal(capture[3].color, color_image(3))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("form", ["png", "jpeg"])
def test_compressed_color(kind: Kind, form: str, tmp_path: Path) -> None:
    messages = Messages(kind)
    sent = scan(messages)
    for row, (topic, at, message) in enumerate(sent):
        if topic == COLOR:
            data = encode(message.data.reshape(*SIZE[::-1], 3), f".{form}")
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            packed = messages.compressed(data, f"rgb8; {form} compressed bgr8", stamp)
            sent[row] = (f"{COLOR}/compressed", at, packed)
    capture = open_bag(write_bag(tmp_path / "scan", messages, sent))
    error = np.abs(capture[2].color.astype(int) - color_image(2))
    assert error.max() == 0 if form == "png" else error.mean() < 4
    assert capture.intrinsics_known


def floats(index: int) -> NDArray[np.float32]:
    depth_m = (depth_image(index) / 1000).astype(np.float32)
    depth_m[3] = np.nan
    return depth_m


def test_depth_in_float_meters(tmp_path: Path) -> None:
    messages = Messages("bag")
    sent = [(t, at, m) for t, at, m in scan(messages) if t != DEPTH]
    sent += [(DEPTH, at, messages.image(floats(n), "32FC1", second(n))) for n, at in enumerate(range(COUNT))]
    frame = open_bag(write_bag(tmp_path / "scan.bag", messages, sent))[1]
    np.testing.assert_array_equal(frame.depth_m, np.nan_to_num(floats(1)))


@pytest.mark.parametrize("form", ["png", "rvl"])
def test_compressed_depth(form: str, tmp_path: Path) -> None:
    messages = Messages("db3")
    sent = [one for one in scan(messages) if one[0] != DEPTH]
    for index in range(COUNT):
        image = depth_image(index)
        image[5, 4:20] = 3000 + np.arange(16) * 7
        packed = encode(image, ".png") if form == "png" else struct.pack("<II", *SIZE) + rvl(image)
        data = struct.pack("<iff", 0, 0, 0) + packed
        told = f"16UC1; compressedDepth {form}"
        sent.append((f"{DEPTH}/compressedDepth", index, messages.compressed(data, told, second(index))))
    frame = open_bag(write_bag(tmp_path / "scan", messages, sent))[2]
    expected = depth_image(2) / 1000
    expected[5, 4:20] = 3 + np.arange(16) * 0.007
    np.testing.assert_allclose(frame.depth_m, expected, atol=1e-6)


def rvl(image: NDArray[np.uint16]) -> bytes:
    """RVL, written as its paper describes it."""
    nibbles: list[int] = []

    def put(value: int) -> None:
        while True:
            more = value >> 3
            nibbles.append(value & 7 | (8 if more else 0))
            value = more
            if not more:
                return

    flat, at, previous = image.reshape(-1).astype(int), 0, 0
    while at < len(flat):
        zeros = at
        while at < len(flat) and not flat[at]:
            at += 1
        put(at - zeros)
        start = at
        while at < len(flat) and flat[at]:
            at += 1
        put(at - start)
        for value in flat[start:at].tolist():
            step = value - previous
            put(step << 1 if step >= 0 else (-step << 1) - 1)
            previous = value
    nibbles += [0] * (-len(nibbles) % 8)
    words = np.array(nibbles, np.uint32).reshape(-1, 8)
    return bytes((words << np.arange(28, -4, -4, dtype=np.uint32)).sum(axis=1).astype("<u4").tobytes())


def test_compressed_depth_of_floats_is_inverse_depth(tmp_path: Path) -> None:
    messages = Messages("bag")
    a, b = 5000.0, 10.0
    depth_m = (depth_image(0) / 1000).astype(np.float32)
    stored = np.where(depth_m > 0, np.rint(a / np.maximum(depth_m, 0.1) + b), 0).astype(np.uint16)
    data = struct.pack("<iff", 0, a, b) + encode(stored, ".png")
    sent = [one for one in scan(messages) if one[0] != DEPTH]
    packed = messages.compressed(data, "32FC1; compressedDepth", second(0))
    sent.append((f"{DEPTH}/compressedDepth", 0, packed))
    frame = open_bag(write_bag(tmp_path / "scan.bag", messages, sent))[0]
    np.testing.assert_allclose(frame.depth_m, depth_m, atol=1e-3)


@pytest.mark.parametrize(
    ("encoding", "stored"),
    [
        ("bgr8", lambda image: image[..., ::-1]),
        ("rgba8", lambda image: np.dstack((image, image[..., :1]))),
        ("bgra8", lambda image: np.dstack((image[..., ::-1], image[..., :1]))),
        ("mono8", lambda image: image[..., 0]),
    ],
)
def test_other_encodings_and_padded_rows(encoding: str, stored: Any, tmp_path: Path) -> None:
    messages = Messages("mcap")
    image = np.repeat(color_image(0)[..., :1], 3, axis=2) if encoding == "mono8" else color_image(0)
    sent: list[Sent] = [(COLOR, n, messages.image(stored(image), encoding, second(n), pad=8)) for n in range(2)]
    capture = open_bag(write_bag(tmp_path / "scan", messages, sent))
    assert not capture.has_depth
    np.testing.assert_array_equal(capture[0].color, image)
    assert not capture[0].depth_m.any()


def test_bayer_and_yuv_keep_colors(tmp_path: Path) -> None:
    flat = np.full((24, 32, 3), (200, 100, 40), np.uint8)
    mosaic = np.zeros((24, 32), np.uint8)
    mosaic[::2, ::2], mosaic[1::2, 1::2] = 200, 40
    mosaic[::2, 1::2] = mosaic[1::2, ::2] = 100
    y, u, v = 122, 87, 176  # BT.601, limited range
    uyvy = np.zeros((24, 32, 2), np.uint8)
    uyvy[..., 1], uyvy[:, ::2, 0], uyvy[:, 1::2, 0] = y, u, v
    for encoding, image in (("bayer_rggb8", mosaic), ("yuv422", uyvy), ("yuv422_yuy2", uyvy[..., ::-1])):
        messages = Messages("bag")
        sent: list[Sent] = [(COLOR, n, messages.image(image, encoding, second(n))) for n in range(2)]
        color = open_bag(write_bag(tmp_path / encoding, messages, sent))[0].color
        assert np.abs(color[4:-4, 4:-4].astype(int) - flat[0, 0]).max() <= 6, encoding


def test_big_endian_depth(tmp_path: Path) -> None:
    messages = Messages("bag")
    sent = [one for one in scan(messages) if one[0] != DEPTH]
    sent += [(DEPTH, n, messages.image(depth_image(n).astype(">u2"), "16UC1", second(n))) for n in range(COUNT)]
    frame = open_bag(write_bag(tmp_path / "scan.bag", messages, sent))[1]
    np.testing.assert_allclose(frame.depth_m, depth_image(1) / 1000, atol=1e-6)


def test_frames_pair_by_their_stamps_and_the_rest_is_counted(tmp_path: Path) -> None:
    """Depth at a third of the rate, and recorded late: the stamps count."""
    messages = Messages("bag")
    sent: list[Sent] = [(COLOR, n, messages.image(color_image(n), "rgb8", second(n))) for n in range(9)]
    for n in range(0, 9, 3):
        sent.append((DEPTH, 10**9 + n, messages.image(depth_image(n), "16UC1", second(n) + 0.03)))
    capture = open_bag(write_bag(tmp_path / "scan.bag", messages, sent))
    np.testing.assert_allclose(capture.timestamps, [second(n) for n in (0, 3, 6)], atol=1e-6)
    np.testing.assert_allclose(capture[2].depth_m[0, 5], 2.06, atol=1e-6)
    assert [notice.code for notice in capture.warnings] == ["images-left-out"]
    assert "6 color images without a partner within" in capture.warnings[0].text


def test_without_stamps_the_time_of_recording_counts(tmp_path: Path) -> None:
    messages = Messages("mcap")
    sent: list[Sent] = [(COLOR, 10**9 * (n + 1), messages.image(color_image(n), "rgb8", 0)) for n in range(3)]
    capture = open_bag(write_bag(tmp_path / "scan", messages, sent))
    np.testing.assert_allclose(capture.timestamps, [1, 2, 3])


def test_no_depth_is_read_if_none_is_wanted(tmp_path: Path) -> None:
    messages = Messages("bag")
    capture = open_bag(write_bag(tmp_path / "scan.bag", messages, scan(messages)), depth=False)
    assert not capture.has_depth
    assert not capture[0].depth_m.any()


def test_two_color_cameras_need_a_choice(tmp_path: Path) -> None:
    messages = Messages("db3")
    sent = [*scan(messages), *scan(messages, "/front/image_raw", "/front/depth/image_raw")]
    path = write_bag(tmp_path / "scan", messages, sent)
    with pytest.raises(CaptureError, match=r"color images of 2 cameras: /camera/color/image_raw, /front/image_raw"):
        open_bag(path)
    own = {"ros_bag": {"color_topic": "/front/image_raw"}}
    capture = open_capture(path, Options(), own)
    assert [topic.name for topic in capture._topics] == ["/front/image_raw", "/front/depth/image_raw"]  # type: ignore[attr-defined]
    with pytest.raises(CaptureError, match=r"no color images of the topic /side.*it has.*/front/image_raw"):
        Reader(path, Options(), ros_bag.Options(color_topic="/side"))


def test_depth_that_is_aligned_to_color_is_preferred(tmp_path: Path) -> None:
    messages = Messages("bag")
    aligned = "/camera/aligned_depth_to_color/image_raw"
    sent = scan(messages)
    sent += [(aligned, n, messages.image(depth_image(n + 1), "16UC1", second(n))) for n in range(COUNT)]
    sent += [("/camera/infra1/image_rect_raw", n, messages.image(color_image(0)[..., 0], "mono8", n)) for n in (1, 2)]
    capture = open_bag(write_bag(tmp_path / "scan.bag", messages, sent))
    np.testing.assert_allclose(capture[0].depth_m[0, 5], 2.01, atol=1e-6)
    own = ros_bag.Options(depth_topic=DEPTH)
    np.testing.assert_allclose(Reader(capture.path, Options(), own)[0].depth_m[0, 5], 2, atol=1e-6)


def test_a_bag_without_images_lists_none(tmp_path: Path) -> None:
    messages = Messages("mcap")
    path = write_bag(tmp_path / "scan", messages, [("/chatter", 1, messages.text("hello"))])
    with pytest.raises(CaptureError, match="holds no color images of a kind that is read"):
        open_bag(path)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bags_are_refused_in_a_sentence(kind: Kind, tmp_path: Path) -> None:
    messages = Messages(kind)
    path = write_bag(tmp_path / "scan", messages, scan(messages))
    file = path if kind == "bag" else stored_file(path)
    whole = file.read_bytes()
    for size in (0, 5, 20, 100, len(whole) // 2, len(whole) - 3):
        file.write_bytes(whole[:size])
        refused(file)
    rng = np.random.default_rng(0)
    for _ in range(60):
        damaged = np.frombuffer(whole, np.uint8).copy()
        at = rng.integers(0, len(damaged), 8)
        damaged[at] = rng.integers(0, 256, 8)
        file.write_bytes(damaged.tobytes())
        refused(file)


def refused(file: Path) -> None:
    """A bag is read, or refused as a bag or at a frame; nothing else happens."""
    said = []
    try:
        capture = open_bag(file)
        for index in range(len(capture)):
            try:
                capture[index]
            except FrameError as error:
                said.append(str(error))
    except CaptureError as error:
        said.append(str(error))
    assert all(str(file) in sentence and "\n" not in sentence for sentence in said)


def test_folders_in_place_of_files(tmp_path: Path) -> None:
    (tmp_path / "scan.bag").mkdir()
    with pytest.raises(CaptureError, match=r"holds no \.mcap or \.db3"):
        open_bag(tmp_path / "scan.bag")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "a.mcap").mkdir()
    with pytest.raises(CaptureError, match="a folder, not a regular file"):
        open_bag(tmp_path / "bag")
    (tmp_path / "other.mcap").write_text("nothing of a bag")
    with pytest.raises(CaptureError, match="none of the formats"):
        open_capture(tmp_path / "other.mcap")


def test_an_image_that_lies_about_its_size_breaks_its_frame_only(tmp_path: Path) -> None:
    messages = Messages("db3")
    sent = scan(messages)
    sent[3][2].height = 1 << 30
    capture = open_bag(write_bag(tmp_path / "scan", messages, sent))
    with pytest.raises(FrameError, match=r"Message 1 of /camera/color/image_raw.*not possible"):
        capture[1]
    assert capture[2].color.any()


@pytest.mark.parametrize("kind", KINDS)
def test_opening_many_frames_is_fast(kind: Kind, tmp_path: Path) -> None:
    """The index and the headers are read, but no image."""
    messages = Messages(kind)
    image = np.zeros((48, 64, 3), np.uint8)
    sent: list[Sent] = []
    for index in range(10_000):
        sent.append((COLOR, index * 10**8, messages.image(image, "rgb8", second(index))))
    path = write_bag(tmp_path / "scan", messages, sent)
    start = time.process_time()
    capture = open_bag(path)
    opening = time.process_time() - start
    assert len(capture) == 10_000
    start = time.process_time()
    for index in range(5000, 5200):
        capture[index]
    assert opening < 50 * max(time.process_time() - start, 0.05), "less than to read all frames"


def test_a_recording_of_realsense() -> None:
    """Against Open3D, whose reader uses RealSense's own library and aligns depth to color."""
    import open3d as o3d

    path = data_folder() / "wild" / "realsense-one-pair.bag"
    if not path.is_file():
        pytest.skip(f"{path} is missing")
    capture = open_bag(path)
    assert (len(capture), capture.units_per_meter, capture.intrinsics_known) == (1, 1000, True)
    reader = o3d.t.io.RSBagReader()
    assert reader.open(str(path))
    image = reader.next_frame()
    reader.close()
    np.testing.assert_array_equal(capture.stored_color(0), image.color.as_tensor().numpy())
    aligned = image.depth.as_tensor().numpy()[..., 0] / 1000
    depth_m = capture[0].depth_m
    both = (aligned > 0) & (depth_m > 0)
    assert both.mean() > 0.95
    assert np.median(np.abs(aligned - depth_m)[both]) < 0.01  # the next depth image, 0.17 s later, is the one aligned
