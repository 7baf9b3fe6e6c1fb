"""Keeps the frames of a run compactly on the disk, so that layers 2-4 need not decode the capture again.

Decoding a frame of the capture, bringing color and depth to one pixel grid and completing its depth takes several times
as long as reading it here. Depth is kept as integers, colors as a reduced JPEG: cells average the colors of many
pixels. A frame that is not in the cache is read from the capture and goes the same way, so that a run that was stopped,
or whose cache is full, makes the same map.
"""

from __future__ import annotations

import contextlib
import os
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

from ..core.depth_sensors import DepthSensor
from ..core.errors import FrameError
from ..core.types import Frame, Intrinsics
from .packed_depth import pack_depth, unpack_depth

_MOST_BYTES = 1 << 30
"""Of the cache's file: some 3000 frames of 640 x 480. Later frames are read from the capture."""
_AHEAD = 4  # frames that wait to be written or are read ahead
_UNITS = 1000.0, 5000.0
"""Units per meter that stored depth usually has: if one of them represents a depth exactly, it is used."""
_FINEST = 8000.0
"""Units per meter otherwise; an eighth of a millimeter is a small part of any sensor's noise."""
_MOST_UNITS = np.iinfo(np.uint16).max
_JPEG_QUALITY = 95


@dataclass(frozen=True)
class _Packed:
    """A frame as bytes. sizes: of the parts depth, color and standard deviation (0 = it has none)."""

    index: int
    timestamp: float
    intrinsics: Intrinsics
    sizes: tuple[int, int, int]
    units: tuple[float, float]
    sensor: DepthSensor
    data: bytes


class FrameCache:
    """The frames of a run by their index. folder: for a file without a name, which ends with this object.

    read: gives a frame of the capture as the run sees it; raises FrameError.  shrink: the factor by which colors are
    reduced; ``frames`` enlarges them again.
    """

    def __init__(self, folder: Path, read: Callable[[int], Frame], shrink: Callable[[Frame], int]):
        self._folder, self._read, self._shrink = folder, read, shrink
        self._file: IO[bytes] | None = None
        self._bytes = 0
        self._at: dict[int, tuple[int, _Packed]] = {}  # place in the file, and the frame without its data
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="frame-cache")
        self._waiting: deque[Future[None]] = deque()

    def keep(self, frame: Frame) -> None:
        """Keep a frame, on another thread."""
        while len(self._waiting) >= _AHEAD:
            self._waiting.popleft().result()
        self._waiting.append(self._writer.submit(lambda: self._write(self._pack(frame))))

    def frames(self, indices: Iterable[int]) -> Generator[Frame | FrameError]:
        """The frames of these indices in this order, read ahead on another thread; an error for a broken one."""
        while self._waiting:
            self._waiting.popleft().result()
        pending: deque[Future[Frame | FrameError]] = deque()
        reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="frame-cache")
        try:
            for index in indices:
                pending.append(reader.submit(self._frame, index))
                if len(pending) > _AHEAD:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            reader.shutdown(wait=True, cancel_futures=True)

    def _frame(self, index: int) -> Frame | FrameError:
        if index in self._at:
            place, packed = self._at[index]
            assert self._file is not None
            return _unpack(packed, os.pread(self._file.fileno(), sum(packed.sizes), place))
        try:
            packed = self._pack(self._read(index))
        except FrameError as error:
            return error.with_traceback(None)
        self._write(packed)
        return _unpack(packed, packed.data)

    def _write(self, packed: _Packed) -> None:
        """Writes a frame, if there is room. A full disk is no error: the frame will be read from the capture."""
        if packed.index in self._at or self._bytes + len(packed.data) > _MOST_BYTES:
            return
        with contextlib.suppress(OSError):
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115, it stays open
            written = os.pwrite(self._file.fileno(), packed.data, self._bytes)
            if written == len(packed.data):
                self._at[packed.index] = self._bytes, replace(packed, data=b"")
                self._bytes += written

    def _pack(self, frame: Frame) -> _Packed:
        units = _choose_units(frame.depth_m)
        depth = pack_depth(_integers(frame.depth_m, units))
        color = _encode_color(frame.color, self._shrink(frame))
        sigma, sigma_units = np.zeros(0, np.uint8), 0.0
        if frame.depth_sigma_m is not None:
            known = np.where(frame.depth_m > 0, frame.depth_sigma_m, np.float32(0))
            sigma_units = min(_FINEST, _MOST_UNITS / max(float(known.max(initial=0)), 1e-3))
            least = np.where(frame.depth_m > 0, np.float32(1), np.float32(0))  # 0 would weigh infinitely
            sigma = pack_depth(np.maximum(_integers(known, sigma_units), least.astype(np.uint16)))
        sizes = len(depth), len(color), len(sigma)
        data = b"".join((depth.tobytes(), color, sigma.tobytes()))
        return _Packed(frame.index, frame.timestamp, frame.intrinsics, sizes, (units, sigma_units), frame.sensor, data)


def _unpack(packed: _Packed, data: bytes) -> Frame:
    camera = packed.intrinsics
    shape = camera.height, camera.width
    depth, color, sigma = np.split(np.frombuffer(data, np.uint8), np.cumsum(packed.sizes)[:2])
    bgr = cv2.imdecode(color, cv2.IMREAD_COLOR)
    if bgr.shape[:2] != shape:
        bgr = cv2.resize(bgr, shape[::-1], interpolation=cv2.INTER_LINEAR)
    sigma_m = unpack_depth(sigma, shape, 1 / packed.units[1]) if len(sigma) else None
    return Frame(
        packed.index,
        packed.timestamp,
        cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB, dst=bgr),
        unpack_depth(depth, shape, 1 / packed.units[0]),
        camera,
        sigma_m,
        packed.sensor,
    )


def _choose_units(depth_m: NDArray[np.float32]) -> float:
    """Units per meter that represent the depth exactly, or else finely."""
    largest = max(float(depth_m.max(initial=0)), 1e-3)
    for units in _UNITS:
        if largest * units <= _MOST_UNITS:
            again = _integers(depth_m, units).astype(np.float32) * np.float32(1 / units)
            if np.array_equal(again, depth_m):
                return units
    return min(_FINEST, _MOST_UNITS / largest)


def _integers(values_m: NDArray[np.float32], units: float) -> NDArray[np.uint16]:
    return np.rint(values_m * np.float32(units)).clip(0, _MOST_UNITS).astype(np.uint16)


def _encode_color(color: NDArray[np.uint8], shrink: int) -> bytes:
    if shrink > 1:
        size = max(1, color.shape[1] // shrink), max(1, color.shape[0] // shrink)
        color = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(color, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
