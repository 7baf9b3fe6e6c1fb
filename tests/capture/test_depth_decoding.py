"""Stored depth of every kind: what each format's own writer wrote comes back."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray
from small_captures import truncate

from freeocc3d.capture.images.depth_decoding import convert_to_meters, read_depth_size, read_raw_depth, usual_units
from freeocc3d.core.errors import FrameError

INTEGERS = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5001
FLOATS = (INTEGERS / 5001).astype(np.float32) + np.float32(0.1)


def write_exr(path: Path, image: NDArray[np.float32]) -> None:
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"Z": image}).write(str(path))


def write_pgm(path: Path, image: NDArray[np.uint16]) -> None:
    path.write_bytes(b"P5\n# a comment\n4 3\n65535\n" + image.astype(">u2").tobytes())


def write_pfm(path: Path, image: NDArray[np.float32], order: str = "<") -> None:
    scale = b"-1.0" if order == "<" else b"1.0"
    path.write_bytes(b"Pf\n4 3\n" + scale + b"\n" + image[::-1].astype(f"{order}f4").tobytes())


WRITERS = {
    "a.png": (INTEGERS, lambda path, image: cv2.imwrite(str(path), image)),
    "a.tiff": (INTEGERS, lambda path, image: cv2.imwrite(str(path), image)),
    "a.pgm": (INTEGERS, write_pgm),
    "b.pgm": (INTEGERS, lambda path, image: cv2.imwrite(str(path), image)),
    "a.npy": (INTEGERS, np.save),
    "b.npy": (FLOATS, np.save),
    "c.npy": (FLOATS.astype(np.float64)[..., None], np.save),
    "a.npz": (FLOATS, lambda path, image: np.savez_compressed(path, depth=image, other=image[:1])),
    "b.npz": (FLOATS, lambda path, image: np.savez(path, image)),
    "a.tif": (FLOATS, lambda path, image: cv2.imwrite(str(path), image)),
    "a.pfm": (FLOATS, write_pfm),
    "b.pfm": (FLOATS, lambda path, image: write_pfm(path, image, ">")),
    "c.pfm": (FLOATS, lambda path, image: cv2.imwrite(str(path), image)),
    "a.exr": (FLOATS, write_exr),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_kind_comes_back_bit_by_bit(name: str, tmp_path: Path) -> None:
    image, write = WRITERS[name]
    write(tmp_path / name, image)
    read = read_raw_depth(tmp_path / name, (4, 3))
    assert read.dtype in (np.uint16, np.float32)
    assert np.array_equal(read, image.reshape(3, 4))
    assert read_depth_size(tmp_path / name) == (4, 3)
    assert usual_units(read) == (1000.0 if image.dtype == np.uint16 else 1.0)


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_is_cut_off_or_of_another_size_is_refused(name: str, tmp_path: Path) -> None:
    image, write = WRITERS[name]
    path = tmp_path / name
    write(path, image)
    with pytest.raises(FrameError, match=r"4 x 3 pixels, (but other frames have|not) 5 x 3"):
        read_raw_depth(path, (5, 3))
    truncate(path)
    with pytest.raises(FrameError, match=str(path)):
        read_raw_depth(path)
    path.write_bytes(b"")
    with pytest.raises(FrameError, match=str(path)):
        read_raw_depth(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(FrameError, match=str(path)):
        read_raw_depth(path)


def test_a_file_that_states_too_many_pixels_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    (tmp_path / "a.pgm").write_bytes(b"P5\n100000 100000\n65535\n" + bytes(100))
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (200000, 200000), }\n"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(100))
    for name in ("a.pgm", "a.npy"):
        with pytest.raises(FrameError):
            read_raw_depth(tmp_path / name)


def test_an_exr_image_with_any_part_damaged_is_read_or_refused(tmp_path: Path) -> None:
    """Also where OpenEXR opens the file, and fails later."""
    write_exr(tmp_path / "a.exr", FLOATS)
    whole = (tmp_path / "a.exr").read_bytes()
    refused: list[str] = []
    for start in range(4, len(whole), 3):
        for damaged in (whole[:start] + bytes(20) + whole[start + 20 :], whole[:start] + whole[start + 20 :]):
            (tmp_path / "a.exr").write_bytes(damaged)
            try:
                assert read_raw_depth(tmp_path / "a.exr").shape
            except FrameError as error:
                refused.append(str(error))
    assert len(refused) > 50
    assert all("a.exr" in said for said in refused)


def test_an_exr_image_of_many_large_channels_is_refused_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(kind, {name: np.ones((4, 8), np.float32) for name in "ABCDEZ"}).write(str(path))
    data = path.read_bytes()
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    path.write_bytes(data[:at] + struct.pack("<4i", 0, 0, 8191, 8191) + data[at + 16 :])
    with pytest.raises(FrameError, match="8192 x 8192 pixels of 6 channels"):
        read_raw_depth(path)


def test_floats_that_are_no_depth_are_no_measurement() -> None:
    raw = np.array([[np.nan, np.inf, -np.inf, -1.0, 0.0, 2.5, 7.0]], np.float32)
    assert convert_to_meters(raw, 1.0, 6.0).tolist() == [[0, 0, 0, 0, 0, 2.5, 0]]


def test_saturated_integers_are_no_measurement() -> None:
    raw = np.array([[0, 65535, 6000, 30000]], np.uint16)
    assert np.allclose(convert_to_meters(raw, 5000.0, 20.0), [[0, 0, 1.2, 6.0]])


def test_color_and_classes_are_no_depth(tmp_path: Path) -> None:
    for name, image in (("c.png", np.zeros((3, 4, 3), np.uint16)), ("g.png", np.zeros((3, 4), np.uint8))):
        cv2.imwrite(str(tmp_path / name), image)
        with pytest.raises(FrameError, match="is not a depth image: expected 16-bit gray or floats"):
            read_raw_depth(tmp_path / name)
