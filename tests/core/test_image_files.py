"""Encoded images: only a regular file with a possible header reaches a decoder."""

from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from freeocc3d.core import image_files
from freeocc3d.core.image_files import ImageFileError, WrongSizeError, decode_bytes, read_image, read_image_size

FORMATS = ("png", "jpg", "tif", "bmp", "webp")
STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def encoded(suffix: str, width: int = 40, height: int = 24) -> bytes:
    image = (np.indices((height, width)).sum(axis=0)[..., None] * (1, 2, 3)).astype(np.uint8)
    return bytes(cv2.imencode(f".{suffix}", image, [cv2.IMWRITE_WEBP_QUALITY, 90] if suffix == "webp" else [])[1])


def stating(suffix: str, width: int, height: int) -> bytes:
    """An image whose header states another size than its data have."""
    data = bytearray(encoded(suffix))
    if suffix == "png":
        struct.pack_into(">II", data, 16, width, height)
        struct.pack_into(">I", data, 29, zlib.crc32(data[12:29]))
    elif suffix == "jpg":
        struct.pack_into(">HH", data, data.index(b"\xff\xc0") + 5, height, width)
    elif suffix == "bmp":
        struct.pack_into("<ii", data, 18, width, -height)
    elif suffix == "webp":
        at = data.index(b"VP8 ") + 14
        struct.pack_into("<HH", data, at, width, height)
    else:
        ifd = struct.unpack_from("<I", data, 4)[0]
        for tag, value in ((256, width), (257, height)):
            entry = data.index(struct.pack("<H", tag), ifd + 2)
            struct.pack_into("<HHII", data, entry, tag, 4, 1, value)
    return bytes(data)


@pytest.mark.parametrize("suffix", FORMATS)
def test_each_format_is_read_as_opencv_reads_it(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"image.{suffix}"
    path.write_bytes(encoded(suffix))
    assert read_image_size(path) == (40, 24)
    image = read_image(path, cv2.IMREAD_COLOR, (40, 24))
    np.testing.assert_array_equal(image, cv2.imread(str(path)))


@pytest.mark.parametrize("options", [{}, {"lossless": True}, {"exif": b"Exif\0\0II*\0\x08\0\0\0\0\0\0\0\0\0"}])
def test_the_three_forms_of_webp(tmp_path: Path, options: dict[str, object]) -> None:
    from PIL import Image

    stream = io.BytesIO()
    Image.new("RGB", (300, 20), (9, 8, 7)).save(stream, "WEBP", **options)
    (path := tmp_path / "image.webp").write_bytes(stream.getvalue())
    assert read_image_size(path) == (300, 20)


@pytest.mark.parametrize("mode", ["I;16", "I;16B"])
def test_tiff_of_both_byte_orders_and_16_bits(tmp_path: Path, mode: str) -> None:
    from PIL import Image

    path = tmp_path / "image.tif"
    Image.new(mode, (33, 20), 700).save(path)
    assert read_image_size(path) == (33, 20)
    assert (read_image(path, cv2.IMREAD_UNCHANGED) == 700).all()


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_huge_size_is_refused_by_the_header(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The decoder would take gigabytes, or raise an error of its own."""
    sides = (16383, 16383) if suffix == "webp" else (40000, 40000)
    (path := tmp_path / f"image.{suffix}").write_bytes(stating(suffix, *sides))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("the decoder saw it"))
    with pytest.raises(ImageFileError, match=rf"image\.{suffix} states {sides[0]} x {sides[1]} pixels"):
        read_image(path, STORED)
    with pytest.raises(ImageFileError, match="more than the 100 million"):
        read_image_size(path)


@pytest.mark.parametrize("suffix", FORMATS)
def test_another_size_is_refused_before_decoding(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (path := tmp_path / f"image.{suffix}").write_bytes(stating(suffix, 3000, 3000))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("the decoder saw it"))
    with pytest.raises(WrongSizeError, match="has 3000 x 3000 pixels, not 40 x 24") as caught:
        read_image(path, STORED, (40, 24))
    assert caught.value.found == (3000, 3000)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_cut_anywhere_is_refused_or_whole(tmp_path: Path, suffix: str) -> None:
    data = encoded(suffix)
    path = tmp_path / f"image.{suffix}"
    for length in (*range(min(len(data), 64)), len(data) // 2):
        path.write_bytes(data[:length])
        with pytest.raises(ImageFileError, match=r"not a readable image|is cut off"):
            read_image(path, STORED)


def test_a_tile_of_a_tiff_counts(tmp_path: Path) -> None:
    entries = [(256, 40), (257, 24), (322, 1 << 20), (323, 1 << 20)]
    data = b"II*\0" + struct.pack("<IH", 8, len(entries))
    data += b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries) + bytes(4)
    (path := tmp_path / "image.tif").write_bytes(data)
    with pytest.raises(ImageFileError, match="1048576 x 1048576"):
        read_image_size(path)


def test_a_jpeg_of_a_thousand_scans_is_refused(tmp_path: Path) -> None:
    data = encoded("jpg", 400, 400)
    (path := tmp_path / "image.jpg").write_bytes(data[:-2] + b"\xff\xda\0\x02" * 1000 + data[-2:])
    with pytest.raises(ImageFileError, match="scans"):
        read_image(path, STORED)


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "loop", "dangling", "missing", "socket"])
def test_only_regular_files_are_opened(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "image.png"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        import socket

        socket.socket(socket.AF_UNIX).bind(str(path))
    elif kind != "missing":
        path.symlink_to({"device": Path("/dev/zero"), "loop": path, "dangling": tmp_path / "none"}[kind])
    for read in (read_image_size, lambda path: read_image(path, STORED)):
        with pytest.raises(ImageFileError, match=r"Cannot read .*image\.png: "):
            read(path)


def test_other_content_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"text", bytes(100), b"GIF89a" + bytes(90), b"P6 9999999 9999999 255\n", b"BM" + bytes(60)):
        (path := tmp_path / "image.png").write_bytes(content)
        with pytest.raises(ImageFileError, match="not a readable image: expected PNG, JPEG"):
            read_image(path, STORED)


def test_an_error_of_the_decoder_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise cv2.error("assertion failed")

    (path := tmp_path / "image.png").write_bytes(encoded("png"))
    monkeypatch.setattr(cv2, "imdecode", broken)
    with pytest.raises(ImageFileError, match="not a readable image"):
        read_image(path, STORED)


def test_a_jpeg_header_is_found_as_decoders_find_it(tmp_path: Path) -> None:
    """Bytes between segments are skipped, and so are fill bytes."""
    data = encoded("jpg")
    for between in (b"\xff\xff\xff", b"\0\0\0", b"\xff\x01", b"\xff\xfe\0\x04ab"):
        (path := tmp_path / "image.jpg").write_bytes(data[:2] + between + data[2:])
        assert image_files.read_image_size(path) == (40, 24)


def test_a_chunk_of_a_png_that_is_longer_than_the_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV takes memory for it: up to 4 GB."""
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("the decoder saw it"))
    data = encoded("png")
    for at in (8, data.index(b"IDAT") - 4):
        for length in (1 << 20, 0x7FFFFFFF, 0xFFFFFFFF):
            (path := tmp_path / "image.png").write_bytes(data[:at] + struct.pack(">I", length) + data[at + 4 :])
            with pytest.raises(ImageFileError, match="not a readable image"):
                read_image(path, STORED)


def test_bytes_decode_as_their_file_does(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (24, 40, 3), np.uint8)
    data = cv2.imencode(".png", image)[1].tobytes()
    assert np.array_equal(decode_bytes(data, tmp_path / "a.zip" / "0.png", cv2.IMREAD_COLOR, (40, 24)), image)
    with pytest.raises(ImageFileError, match=r"a\.zip/0\.png is cut off"):
        decode_bytes(data[:-20], tmp_path / "a.zip" / "0.png", cv2.IMREAD_COLOR)
    with pytest.raises(WrongSizeError, match=r"a\.zip/0\.png has 40 x 24 pixels"):
        decode_bytes(data, tmp_path / "a.zip" / "0.png", cv2.IMREAD_COLOR, (24, 40))
