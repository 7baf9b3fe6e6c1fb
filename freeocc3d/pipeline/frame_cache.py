"""Keeps the frames of a run compactly on the disk, so that layers 2-4 need not decode the capture again.

Decoding a frame of the capture, bringing color and depth to one pixel grid and completing its depth takes several times
as long as reading it here. Depth is kept as integers, colors as a reduced JPEG: cells average the colors of many
pixels. A frame that is not in the cache is read from the capture and goes the same way, so that a run that was stopped,
or whose cache is full, makes the same map.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from numpy.typing import NDArray

from ..capture.read_ahead import call_ahead
from ..core.errors import FrameError
from ..core.types import Frame
from .packed_depth import MOST_UNITS, pack_depth, unpack_depth

_MOST_BYTES = 1 << 30
"""Of the cache's file: some 3000 frames of 640 x 480. Later frames are read from the capture."""
_ROOM = 0.5
"""Largest share of the disk's free space for it: keyframes and the map need the rest."""
_AHEAD = 4  # frames that wait to be written or are read ahead
_UNITS = 1000.0, 5000.0
"""Units per meter that stored depth usually has: if one of them represents a depth exactly, it is used."""
_FINEST = 8000.0
"""Units per meter otherwise; an eighth of a millimeter is a small part of any sensor's noise."""
_LEAST_M = 1e-3  # avoids division by the largest depth of an image without any
_JPEG_QUALITY = 95
_NO_COLOR = np.zeros((0, 0, 3), np.uint8)


@dataclass(frozen=True)
class _Packed:
    """A frame as bytes. bare: the frame without its arrays.  sizes: of the parts depth, color and standard deviation (0
    = it has none).  units: per meter, of depth and standard deviation."""

    bare: Frame
    sizes: tuple[int, int, int]
    units: tuple[float, float]
    data: bytes


class FrameCache:
    """The frames of a run by their index. folder: for a file without a name, which ends with this object.

    read: gives a frame of the capture as the run sees it; raises FrameError.  shrink: the factor by which colors are
    reduced; ``frames`` enlarges them again.
    """

    def __init__(self, folder: Path, read: Callable[[int], Frame], shrink: Callable[[Frame], int]):
        self._folder, self._read, self._shrink = folder, read, shrink
        self._file: IO[bytes] | None = None
        self._bytes, self._most = 0, 0  # of the file
        self._at: dict[int, tuple[int, _Packed]] = {}  # place in the file, and the frame without its data
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="frame-cache")
        self._waiting: deque[Future[None]] = deque()

    def keep(self, frame: Frame) -> None:
        """Keep a frame, on another thread."""
        while len(self._waiting) >= _AHEAD:
            self._waiting.popleft().result()
        self._waiting.append(self._writer.submit(lambda: self._write(self._pack(frame))))

    def frames(self, indices: Iterable[int], color: bool = True) -> Generator[Frame | FrameError]:
        """The frames of these indices in this order, read ahead on another thread; an error for a broken one. color:
        false = their colors are left out, an empty array."""
        while self._waiting:
            self._waiting.popleft().result()
        return call_ahead(lambda index: self._frame(index, color), indices, _AHEAD)

    def clear(self) -> None:
        """Give the disk's space back; frames that are asked for later are read from the capture."""
        while self._waiting:
            self._waiting.popleft().result()
        if self._file is not None:
            self._file.close()
        self._file, self._bytes, self._at = None, 0, {}

    def _frame(self, index: int, color: bool) -> Frame | FrameError:
        if index in self._at:
            place, packed = self._at[index]
            assert self._file is not None
            return _unpack(packed, os.pread(self._file.fileno(), sum(packed.sizes), place), color)
        try:
            packed = self._pack(self._read(index))
        except FrameError as error:
            return error.with_traceback(None)
        self._write(packed)
        return _unpack(packed, packed.data, color)

    def _write(self, packed: _Packed) -> None:
        """Writes a frame, if there is room. A full disk is no error: the frame will be read from the capture."""
        if packed.bare.index in self._at:
            return
        with contextlib.suppress(OSError):
            if self._file is None:
                self._most = min(_MOST_BYTES, int(_ROOM * shutil.disk_usage(self._folder).free))
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115, it stays open
            if self._bytes + len(packed.data) > self._most:
                return
            written = os.pwrite(self._file.fileno(), packed.data, self._bytes)
            if written == len(packed.data):
                self._at[packed.bare.index] = self._bytes, replace(packed, data=b"")
                self._bytes += written

    def _pack(self, frame: Frame) -> _Packed:
        depth, units = _pack_finely(frame.depth_m)
        color = _encode_color(frame.color, self._shrink(frame))
        sigma, sigma_units = np.zeros(0, np.uint8), 0.0
        if frame.depth_sigma_m is not None:
            least = np.float32(1 / _FINEST)  # 0 would weigh infinitely
            sigma_m = np.where(frame.depth_m > 0, np.maximum(frame.depth_sigma_m, least), np.float32(0))
            sigma, sigma_units = _pack_finely(sigma_m)
        sizes = len(depth), len(color), len(sigma)
        data = b"".join((depth.tobytes(), color, sigma.tobytes()))
        bare = replace(frame, color=_NO_COLOR, depth_m=np.zeros((0, 0), np.float32), depth_sigma_m=None)
        return _Packed(bare, sizes, (units, sigma_units), data)


def _unpack(packed: _Packed, data: bytes, color: bool) -> Frame:
    shape = packed.bare.intrinsics.height, packed.bare.intrinsics.width
    depth, jpeg, sigma = np.split(np.frombuffer(data, np.uint8), np.cumsum(packed.sizes)[:2])
    return replace(
        packed.bare,
        color=_decode_color(jpeg, shape) if color else _NO_COLOR,
        depth_m=unpack_depth(depth, shape, 1 / packed.units[0]),
        depth_sigma_m=unpack_depth(sigma, shape, 1 / packed.units[1]) if len(sigma) else None,
    )


def _decode_color(jpeg: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    bgr = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    if bgr.shape[:2] != shape:
        bgr = cv2.resize(bgr, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB, dst=bgr), np.uint8)


def _pack_finely(values_m: NDArray[np.float32]) -> tuple[NDArray[np.uint8], float]:
    """Bytes of values in meters, in units that represent them exactly, or else finely, and units per meter."""
    most = MOST_UNITS / max(float(values_m.max(initial=0)), _LEAST_M)
    for units in _UNITS:
        packed, exact = pack_depth(values_m, min(units, most))
        if exact:
            return packed, min(units, most)
    return pack_depth(values_m, min(_FINEST, most))[0], min(_FINEST, most)


def _encode_color(color: NDArray[np.uint8], shrink: int) -> bytes:
    if shrink > 1:
        size = max(1, color.shape[1] // shrink), max(1, color.shape[0] // shrink)
        color = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(color, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
