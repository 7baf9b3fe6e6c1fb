"""What the libraries need to decode a frame's images, as files of a format hold them, with nothing around it."""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import os
import sqlite3
import sys
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .folders import REPOSITORY

Decode = Callable[[bytes], NDArray[Any]]
Compression = tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]


def import_helper(module: str) -> Any:
    """A module of the tests' helpers."""
    folder = str(REPOSITORY / "tests" / "helpers")
    if folder not in sys.path:
        sys.path.append(folder)
    return importlib.import_module(module)


class PackedImages:
    """Images of one kind that lie packed in a file, one after the other. Calling it reads and decodes one."""

    def __init__(self, file: Path, images: list[NDArray[Any]], kind: str):
        """kind: how an image is encoded ("plain", "big" for big-endian, or a suffix of image files), by what that is
        compressed, and whether it lies in a database, such as "png", "plain zlib" or "plain sqlite"."""
        form, *steps = kind.split()
        in_database = steps[-1:] == ["sqlite"]
        steps = steps[:-1] if in_database else steps
        self._decode, self._steps = decoder(form, images[0]), [_COMPRESSION[step]()[1] for step in steps[::-1]]
        packed = [_encode(image, form, file) for image in images]
        for step in steps:
            compress = _COMPRESSION[step]()[0]
            packed = [compress(data) for data in packed]
        self._file = _Database(file, packed) if in_database else _File(file, packed)

    def __call__(self, index: int) -> NDArray[Any]:
        data = self._file.read(index)
        for decompress in self._steps:
            data = decompress(data)
        return self._decode(data)

    def close(self) -> None:
        self._file.close()


class _File:
    def __init__(self, file: Path, packed: Sequence[bytes]):
        self._spans = list(itertools.pairwise((0, *itertools.accumulate(map(len, packed)))))
        file.write_bytes(b"".join(packed))
        self._descriptor = os.open(file, os.O_RDONLY)

    def read(self, index: int) -> bytes:
        start, end = self._spans[index]
        return os.pread(self._descriptor, end - start, start)

    def close(self) -> None:
        os.close(self._descriptor)


class _Database:
    def __init__(self, file: Path, packed: Sequence[bytes]):
        with contextlib.closing(sqlite3.connect(file)) as database:
            database.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, data BLOB)")
            database.executemany("INSERT INTO messages VALUES (?, ?)", enumerate(packed))
            database.commit()
        self._database = sqlite3.connect(f"{file.as_uri()}?immutable=1&mode=ro", uri=True)

    def read(self, index: int) -> bytes:
        data: bytes = self._database.execute("SELECT data FROM messages WHERE id = ?", (index,)).fetchone()[0]
        return data

    def close(self) -> None:
        self._database.close()


def _encode(image: NDArray[Any], form: str, scratch: Path) -> bytes:
    """scratch: a file beside which one may be written on the way."""
    if form in ("plain", "big"):
        return image.astype(">u2" if form == "big" else image.dtype).tobytes()
    if image.ndim == 3 or image.dtype == np.uint8:
        return bytes(cv2.imencode(f".{form}", image[..., ::-1] if image.ndim == 3 else image)[1])
    path = scratch.with_name(f"one.{form}")
    import_helper("scans").write_depth(path, image if image.dtype == np.float32 else (image / 1000).astype(np.float32))
    return path.read_bytes()


def decoder(form: str, like: NDArray[Any]) -> Decode:
    """What decodes an image of that form. like: an image of its size and type."""
    shape, dtype = like.shape, like.dtype

    def plain(data: bytes) -> NDArray[Any]:
        return np.frombuffer(data, ">u2" if form == "big" else dtype).reshape(shape).copy()

    def image(data: bytes) -> NDArray[Any]:
        if len(shape) == 3:
            return cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)

    by_form: dict[str, Decode] = {
        "plain": plain,
        "big": plain,
        "npy": lambda data: np.load(io.BytesIO(data)),
        "npz": lambda data: np.load(io.BytesIO(data))["depth"],
    }
    return by_form.get(form, image)


def _lzfse() -> Compression:
    import lzfse

    return lzfse.compress, lzfse.decompress


def _lz4() -> Compression:
    from lz4 import frame

    return frame.compress, frame.decompress


def _zstd() -> Compression:
    from backports import zstd

    return zstd.compress, zstd.decompress


_COMPRESSION: dict[str, Callable[[], Compression]] = {
    "zlib": lambda: (zlib.compress, zlib.decompress),
    "lzfse": _lzfse,
    "lz4": _lz4,
    "zstd": _zstd,
}


class ExrImages:
    """EXR files, which OpenEXR decodes by their names."""

    def __init__(self, folder: Path, images: list[NDArray[Any]]):
        self._files = [folder / f"{row}.exr" for row in range(len(images))]
        for file, image in zip(self._files, images, strict=True):
            import_helper("scans").write_exr(file, image)

    def __call__(self, index: int) -> NDArray[Any]:
        import OpenEXR

        return np.asarray(OpenEXR.File(str(self._files[index])).channels()["Z"].pixels)

    def close(self) -> None:
        pass


class VideoImages:
    """Color of a video, in order; asking for another frame begins anew."""

    def __init__(self, file: Path, images: list[NDArray[Any]]):
        self._file, self._next = import_helper("written_phones").write_lossless(file, images), 0
        self._begin()

    def __call__(self, index: int) -> NDArray[Any]:
        if index < self._next:
            self.close()
            self._begin()
        while self._next < index:
            next(self._frames)
            self._next += 1
        self._next += 1
        return np.asarray(next(self._frames).to_ndarray(format="rgb24"))

    def close(self) -> None:
        self._container.close()

    def _begin(self) -> None:
        import av

        self._container, self._next = av.open(str(self._file)), 0
        self._frames = self._container.decode(self._container.streams.video[0])
