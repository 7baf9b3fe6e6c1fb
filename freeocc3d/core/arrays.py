"""Writes and reads arrays in .npz files. Writing replaces the whole file. Reading unpickles nothing and checks sizes
before it allocates memory."""

from __future__ import annotations

import contextlib
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from io import BufferedIOBase
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from .atomic_files import replace_file
from .errors import MapError
from .regular_files import UnusableFile, open_regular

Shape = tuple[int | None, ...]

_LARGEST, _AT_ONCE = 8 << 30, 1 << 20
_MAGIC, _LONGEST_HEADER = b"\x93NUMPY", 4096
_HEADER = re.compile(
    r"\{'descr': *'(?P<type>[<>|=]?(?:\?|[biufUS]\d{1,9}))', *'fortran_order': *(?P<columns>True|False), *"
    r"'shape': *\((?P<shape>[\dL, ]{0,99})\),? *\}\s*"
)
"""The header that NumPy writes for simple types. Its own reader evaluates it as Python, and admits records and
objects."""

_ERRORS = (
    OSError, ValueError, EOFError, RuntimeError, OverflowError, IndexError, TypeError, struct.error, zlib.error,
    zipfile.BadZipFile,
)  # fmt: skip
"""What zipfile raises for archives that are damaged, encrypted or packed in an unknown way, and NumPy for a type of no
size."""


class _Unusable(ValueError):
    """An array cannot be used. The message is part of a sentence."""


def write_arrays(path: Path, arrays: Mapping[str, Any], compressed: bool = False) -> None:
    """Write an .npz file; an existing one is replaced. Raises OSError."""
    save = np.savez_compressed if compressed else np.savez
    replace_file(path, lambda temporary: save(temporary, **arrays))


def read_arrays(
    path: Path, expected: Mapping[str, tuple[str, int | Shape]], also: Collection[str] = (), most_bytes: int = _LARGEST
) -> dict[str, NDArray[Any]]:
    """Read arrays of numbers, of truth values or of texts from an .npz file, in the machine's byte order.

    expected: name -> (``dtype.kind``, number of dimensions or shape, in which None is any length); the file must hold
    each of them, but for those in ``also``.  also: names of arrays that are read if they are there. If both are empty,
    all arrays are read.  most_bytes: of all arrays together. Other arrays are not unpacked. Raises MapError.
    """
    try:
        with _named(path), open_regular(path, _LARGEST) as stream, zipfile.ZipFile(stream) as archive:
            return _read(archive, expected, also, most_bytes)
    except FileNotFoundError as error:
        raise MapError(f"{path} is missing: copy the whole map folder again, or make the map again.") from error


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Turns what readers raise about a file that is there into a MapError that names it."""
    try:
        yield
    except FileNotFoundError:
        raise
    except UnusableFile as error:
        raise MapError(f"{path} cannot be read: {error.strerror}.") from error
    except _Unusable as error:
        raise MapError(f"{path} is damaged: {error}.") from error
    except _ERRORS as error:
        raise MapError(f"{path} is damaged: {' '.join(str(error).split()) or 'it ends too early'}.") from error


def _read(
    archive: zipfile.ZipFile, expected: Mapping[str, tuple[str, int | Shape]], also: Collection[str], most_bytes: int
) -> dict[str, NDArray[Any]]:
    infos = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    if len(infos) < len(archive.infolist()):
        raise _Unusable("it holds two arrays of one name")
    arrays = {}
    for name in {**expected, **dict.fromkeys(also)} or infos:
        if name in infos:
            arrays[name] = _read_array(archive, infos[name], expected.get(name), most_bytes)
            most_bytes -= arrays[name].nbytes
        elif name in expected and name not in also:
            raise _Unusable(f"it has no usable array '{name}'")
    return arrays


def read_array(path: Path, most_bytes: int = _LARGEST) -> NDArray[Any]:
    """Read the array of an .npy file, in the machine's byte order. Raises MapError, as ``read_arrays`` does."""
    try:
        with _named(path), open_regular(path, most_bytes + _LONGEST_HEADER) as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            return _unpack(stream, path.name, size, None, most_bytes)
    except FileNotFoundError as error:
        raise MapError(f"{path} cannot be read: {error.strerror}.") from error


def is_whole(path: Path) -> bool:
    """Whether no byte of the arrays in an .npz file was lost or changed since it was written."""
    try:
        with open_regular(path) as stream, zipfile.ZipFile(stream) as archive:
            return archive.testzip() is None
    except _ERRORS:
        return False


def _read_array(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, expected: tuple[str, int | Shape] | None, most_bytes: int
) -> NDArray[Any]:
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise _Unusable(f"its array {info.filename} is packed in a way that NumPy does not write")
    with archive.open(info) as stream:
        return _unpack(stream, info.filename, info.file_size, expected, most_bytes)


def _unpack(
    stream: IO[bytes], name: str, file_size: int, expected: tuple[str, int | Shape] | None, most_bytes: int
) -> NDArray[Any]:
    dtype, in_columns, shape, offset = _header(stream, name)
    if expected is not None and not _fits(dtype, shape, *expected):
        raise _Unusable(f"it has no usable array '{name.removesuffix('.npy')}'")
    size = math.prod(shape) * dtype.itemsize
    if offset + size != file_size:
        raise _Unusable(f"its array {name} is not as large as its header says")
    if size > most_bytes:
        raise _Unusable(f"its array {name} takes {size:,} bytes, more than is possible here")
    data = _filled(cast(BufferedIOBase, stream), size)
    if data is None or stream.read(1):  # at the end, zipfile compares the checksum
        raise _Unusable(f"its array {name} ends too early")
    array = np.frombuffer(data, dtype).reshape(shape, order="F" if in_columns else "C")
    return array if dtype.isnative else array.astype(dtype.newbyteorder("="))


def _filled(stream: BufferedIOBase, size: int) -> bytearray | None:
    """The next bytes of a stream, or None if there are fewer. zipfile copies what it is asked for, so ask for a little
    at a time."""
    data = bytearray(size)
    view = memoryview(data)
    while view:
        count = stream.readinto(view[:_AT_ONCE])
        if not count:
            return None
        view = view[count:]
    return data


def _header(stream: IO[bytes], name: str) -> tuple[np.dtype[Any], bool, tuple[int, ...], int]:
    """Type, whether the first index varies fastest, shape, and the number of bytes before the data."""
    start = stream.read(10)
    long = start[6:7] > b"\x01"
    if long:
        start += stream.read(2)
    length = int.from_bytes(start[8:], "little")
    text = stream.read(min(length, _LONGEST_HEADER))
    found = _HEADER.fullmatch(text.decode("latin-1"))
    if start[:6] != _MAGIC or found is None:
        raise _Unusable(f"its array {name} does not hold plain numbers or texts")
    shape = tuple(int(part.strip("L ")) for part in found["shape"].split(",") if part.strip())
    return np.dtype(found["type"]), found["columns"] == "True", shape, len(start) + length


def _fits(dtype: np.dtype[Any], shape: tuple[int, ...], kind: str, wanted: int | Shape) -> bool:
    if isinstance(wanted, int):
        wanted = (None,) * wanted
    lengths = len(shape) == len(wanted) and all(w in (None, n) for n, w in zip(shape, wanted, strict=True))
    return dtype.kind == kind and lengths
