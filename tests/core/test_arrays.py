"""Arrays in files: reading unpickles nothing, and checks sizes first."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from freeocc3d.core.arrays import read_arrays, write_arrays
from freeocc3d.core.errors import MapError


def test_arrays_are_never_unpickled_and_lies_about_their_size_are_refused(tmp_path) -> None:
    np.savez(tmp_path / "a.npz", keys=np.array([{"a": 1}], dtype=object))
    with pytest.raises(MapError, match="damaged"):
        read_arrays(tmp_path / "a.npz", {})
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)})
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("keys.npy", header.getvalue() + b"\0" * 64)
    with pytest.raises(MapError, match="is not as large as its header says"):
        read_arrays(tmp_path / "b.npz", {})


def test_what_is_expected_must_be_there_and_of_its_kind(tmp_path) -> None:
    np.savez(tmp_path / "a.npz", keys=np.zeros((2, 3), np.int32))
    assert read_arrays(tmp_path / "a.npz", {"keys": ("i", 2)})["keys"].shape == (2, 3)
    for expected in ({"keys": ("f", 2)}, {"keys": ("i", 1)}, {"others": ("i", 2)}):
        with pytest.raises(MapError, match="no usable array"):
            read_arrays(tmp_path / "a.npz", expected)
    with pytest.raises(MapError, match="is missing"):
        read_arrays(tmp_path / "b.npz", {})


ARRAYS = {
    "keys": np.arange(60, dtype=np.int32).reshape(20, 3),
    "names": np.array(["red cup", "é"]),
    "mask": np.array([True, False]),
    "none": np.zeros((0, 3), np.uint8),
    "number": np.float64(0.05),
    "half": np.linspace(0, 1, 7).astype(np.float16),
    "columns": np.asfortranarray(np.arange(12.0).reshape(3, 4)),
    "big": np.arange(5, dtype=">i8"),
}


@pytest.mark.parametrize("compressed", [True, False])
def test_arrays_come_back_as_they_were_and_can_be_changed(tmp_path: Path, compressed: bool) -> None:
    write_arrays(tmp_path / "a.npz", ARRAYS, compressed)
    found = read_arrays(tmp_path / "a.npz", {})
    assert found.keys() == ARRAYS.keys()
    for name, values in ARRAYS.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == np.asarray(values).dtype.newbyteorder("=")
        assert found[name].flags.writeable


def test_only_named_arrays_are_unpacked(tmp_path: Path) -> None:
    write_arrays(tmp_path / "a.npz", {**ARRAYS, "bomb": np.zeros(80 << 20, np.uint8)}, compressed=True)
    assert (tmp_path / "a.npz").stat().st_size < 1 << 20
    found = read_arrays(tmp_path / "a.npz", {"keys": ("i", 2)}, also=("half", "absent"), most_bytes=1 << 20)
    assert found.keys() == {"keys", "half"}
    for expected in ({}, {"bomb": ("u", 1)}):
        with pytest.raises(MapError, match=r"bomb\.npy takes 83,886,080 bytes"):
            read_arrays(tmp_path / "a.npz", expected, most_bytes=1 << 20)


def test_what_is_expected_may_be_missing_if_it_is_optional_but_not_of_another_kind(tmp_path: Path) -> None:
    write_arrays(tmp_path / "a.npz", ARRAYS)
    expected = {"keys": ("i", 2), "absent": ("u", 1)}
    assert read_arrays(tmp_path / "a.npz", expected, also=("absent",)).keys() == {"keys"}
    with pytest.raises(MapError, match="no usable array 'half'"):
        read_arrays(tmp_path / "a.npz", {"half": ("f", 2)}, also=("half",))


@pytest.mark.parametrize(("wanted", "usable"), [((20, 3), True), ((None, 3), True), ((19, 3), False), ((20,), False)])
def test_shapes_are_compared_before_anything_is_unpacked(tmp_path: Path, wanted: tuple, usable: bool) -> None:
    write_arrays(tmp_path / "a.npz", ARRAYS)
    if usable:
        assert read_arrays(tmp_path / "a.npz", {"keys": ("i", wanted)})["keys"].shape == (20, 3)
        return
    with pytest.raises(MapError, match="no usable array 'keys'"):
        read_arrays(tmp_path / "a.npz", {"keys": ("i", wanted)})


def header(text: str, data: bytes = bytes(8)) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + data


def stored(content: bytes, **facts: int) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        with zipfile.ZipFile(path, "w", facts.pop("compression", zipfile.ZIP_DEFLATED)) as archive:
            archive.writestr("keys.npy", content)

    return write


def twice(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("keys.npy", header(shape("(1,)")))
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("keys.npy", header(shape("(1,)")))


def flipped(path: Path) -> None:
    np.savez(path, keys=np.arange(2000))
    data = bytearray(path.read_bytes())
    data[1500] ^= 1
    path.write_bytes(data)


def encrypted(path: Path) -> None:
    np.savez(path, keys=np.arange(20))
    data = bytearray(path.read_bytes())
    for start, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(start) + flags] |= 1
    path.write_bytes(data)


def shape(text: str) -> str:
    return f"{{'descr': '<i8', 'fortran_order': False, 'shape': {text}, }}"


ODD: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "empty": lambda path: path.write_bytes(b""),
    "no archive": lambda path: path.write_bytes(b"PK\x05\x06" + bytes(9)),
    "a flipped bit": flipped,
    "encrypted": encrypted,
    "two of one name": twice,
    "packed by LZMA": stored(header(shape("(1,)")), compression=zipfile.ZIP_LZMA),
    "records": lambda path: np.savez(path, keys=np.zeros(3, [("a", "i4"), ("b", "f8")])),
    "dates": lambda path: np.savez(path, keys=np.zeros(3, "M8[s]")),
    "complex": lambda path: np.savez(path, keys=np.zeros(3, complex)),
    "objects": lambda path: np.savez(path, keys=np.array([None])),
    "no header": stored(b""),
    "a cut header": stored(header(shape("(1,)"))[:20]),
    "deep brackets": stored(header(shape("(" * 3000))),
    "code": stored(header(shape("(__import__('os').getpid(),)"))),
    "a negative length": stored(header(shape("(-1,)"))),
    "lengths whose product is beyond all": stored(header(shape("(" + "9" * 40 + "," + "9" * 40 + ")"))),
    "no width": stored(header("{'descr': '<U0', 'fortran_order': False, 'shape': (9,), }", b"")),
    "an odd width": stored(header("{'descr': '<i7', 'fortran_order': False, 'shape': (1,), }", bytes(7))),
    "too much": stored(header(shape("(1,)"), bytes(9))),
    "another magic": stored(header(shape("(1,)")).replace(b"NUMPY", b"NUMPI")),
}


@pytest.mark.parametrize("kind", ODD)
def test_odd_files_are_refused_with_a_sentence(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.npz"
    ODD[kind](path)
    with pytest.raises(MapError, match=r"a\.npz (is damaged|cannot be read): [^\n]+\.$"):
        read_arrays(path, {})
