"""Reads ScanNet's recordings, one .sens file with all frames; BundleFusion's data have the same format.

Source: ScanNet's SensReader (sensorData.h, version 4). Opening passes over the file once, from frame to frame, and
decodes nothing.
"""

from __future__ import annotations

import struct
import zlib
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError
from ...core.image_files import MOST_PIXELS, Size
from ...core.regular_files import IMAGE_BYTES, open_regular
from ...core.transforms import invert
from ...core.warnings import Notice
from ..base import Options
from ..cameras.camera_files import Calibration, is_pose
from ..cameras.lenses import Lens
from ..cameras.rigs import Rig, StatedCameras, build_rig
from ..files.numbered_files import list_folder
from ..images.depth_decoding import RawDepth
from ..images.image_decoding import decode_color_bytes
from ..poses.frame_poses import ascending_times
from ..rgbd_frames import Registration, RgbdFrames

REQUIRES: tuple[str, ...] = ()

_VERSION = 4
_LONGEST_NAME = 4096
_MOST_FRAMES = 1_000_000
_HEADER = struct.Struct("<64f2i4If")
_FRAME = np.dtype([("T", "<f4", (4, 4)), ("times", "<u8", 2), ("lengths", "<u8", 2)])
_LENGTHS = struct.Struct("<2Q")
_RAW_COLOR, _PNG, _JPEG = 0, 1, 2
_RAW_DEPTH, _ZLIB_DEPTH = 0, 1
_PER_SECOND = 1e6


@dataclass(frozen=True)
class _Header:
    """What stands before the frames. matrices: (4, 4, 4): intrinsics and extrinsics of color, then of depth."""

    matrices: NDArray[np.float64]
    color_type: int
    depth_type: int
    color_size: Size
    depth_size: Size
    units_per_meter: float
    count: int
    end: int


@dataclass(frozen=True)
class _Index:
    """The whole frames. offsets: (N,) of the color data in the file.  lengths: (N, 2) bytes of color and depth.
    T_world_cam: (N, 4, 4) as stored.  times: (N,) microseconds."""

    offsets: NDArray[np.int64]
    lengths: NDArray[np.int64]
    T_world_cam: NDArray[np.float32]
    times: NDArray[np.float64]


class Reader(RgbdFrames):
    """Color is JPEG, PNG or plain, depth 16-bit, plain or packed with zlib. The file states the cameras, the depth
    unit, the poses (-inf = none) and the times. Extrinsics map each camera to the rig, as in exported scenes.

    A folder with one .sens file is read, too, if no frames were exported beside it. Of a file that is cut off, the
    whole frames are used, with a warning. Raises CaptureError for another version or packing, or no whole frame.
    """

    format = "scannet_sens"
    layout = "a .sens file of ScanNet, or a folder with one"
    reads_files = True

    def __init__(self, path: Path, options: Options):
        self._file = _find(path) or path
        try:
            with open_regular(self._file) as stream:
                self._header = header = _read_header(stream, self._file)
                self._index = _read_index(stream, header)
        except OSError as error:
            raise CaptureError(f"Cannot read {self._file}: {error.strerror}.") from error
        if not len(self._index.offsets):
            raise CaptureError(f"{self._file} holds no whole frame: it states {header.count}. Copy it again.")
        depth_size = header.depth_size if options.depth else None
        self._rig, self.intrinsics_known = build_rig(
            _cameras(header, self._file), options, header.color_size, depth_size
        )
        self.focal_stated = self.intrinsics_known
        Registration(self._rig)  # raises CaptureError for a rig of too large images
        super().__init__(path, options, ascending_times(self._index.times / _PER_SECOND), header.units_per_meter)
        if len(self) < header.count:
            self.warnings = (_notice_cut_off(self._file, len(self), header.count),)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        file = _find(path)
        if file is None or file.suffix.lower() == ".sens":
            return file is not None
        try:
            with open_regular(file) as stream:
                _read_header(stream, file)
                return True
        except (OSError, CaptureError):
            return False

    def stored_color(self, index: int) -> NDArray[np.uint8]:
        source, size = self.path / f"frame {index}", self._header.color_size
        data = self._read(index, 0)
        if self._header.color_type != _RAW_COLOR:
            return decode_color_bytes(data, source, size)
        if len(data) != size[0] * size[1] * 3:
            raise FrameError(f"The color of {source} has {len(data)} bytes instead of {size[0]} x {size[1]} x 3.")
        return np.frombuffer(data, np.uint8).reshape(size[1], size[0], 3)

    def stored_depth(self, index: int) -> RawDepth | None:
        width, height = self._header.depth_size
        data, wanted = self._read(index, 1), width * height * 2
        if self._header.depth_type == _ZLIB_DEPTH:
            try:
                data = zlib.decompressobj().decompress(data, wanted + 1)
            except zlib.error as error:
                raise FrameError(f"The depth of frame {index} of {self.path} is damaged: {error}.") from error
        if len(data) != wanted:
            raise FrameError(f"The depth of frame {index} of {self.path} does not have {width} x {height} pixels.")
        return np.frombuffer(data, "<u2").astype(np.uint16, copy=False).reshape(height, width)

    def rig(self, index: int) -> Rig:
        return self._rig

    def pose(self, index: int) -> NDArray[np.float64] | None:
        T = self._index.T_world_cam[index].astype(np.float64)
        return T if is_pose(T) else None

    def _read(self, index: int, part: int) -> bytes:
        """The packed color (0) or depth (1) of a frame. Raises FrameError."""
        lengths = self._index.lengths[index].tolist()
        try:
            with open_regular(self._file) as stream:
                stream.seek(int(self._index.offsets[index]) + part * lengths[0])
                return stream.read(lengths[part])
        except OSError as error:
            raise FrameError(f"Cannot read {self._file}: {error.strerror}.") from error


def _find(path: Path) -> Path | None:
    """The .sens file that ``path`` is, or the only one of a folder without exported frames."""
    if path.is_file():
        return path
    names = list_folder(path)
    found = [name for name in names if name.lower().endswith(".sens") and not name.startswith(".")]
    return path / found[0] if len(found) == 1 and "color" not in names else None


def _read_header(stream: BinaryIO, file: Path) -> _Header:
    """Raises CaptureError if this is no such file."""
    start = stream.read(12)
    version, length = struct.unpack("<IQ", start) if len(start) == 12 else (0, 0)
    name = stream.read(length) if length <= _LONGEST_NAME else b""
    rest = stream.read(_HEADER.size + 8)
    if len(name) < length or len(rest) < _HEADER.size + 8:
        raise CaptureError(f"{file} is not a .sens file of ScanNet: its header is cut off or damaged.")
    if version != _VERSION:
        raise CaptureError(f"{file} is not a .sens file of version {_VERSION}: it states version {version}.")
    *numbers, color_type, depth_type, cw, ch, dw, dh, units = _HEADER.unpack_from(rest)
    matrices = np.array(numbers, np.float64).reshape(4, 4, 4)
    if not (0 < cw * ch <= MOST_PIXELS and 0 < dw * dh <= MOST_PIXELS and 0 < units <= 1e6):
        raise CaptureError(
            f"{file} states impossible frames: color {cw} x {ch}, depth {dw} x {dh}, {units:g} units per meter."
        )
    if color_type not in (_RAW_COLOR, _PNG, _JPEG) or depth_type not in (_RAW_DEPTH, _ZLIB_DEPTH):
        raise CaptureError(
            f"{file} packs its frames in a way that is not read (color {color_type}, depth {depth_type}): export them "
            "with ScanNet's SensReader."
        )
    count = struct.unpack_from("<Q", rest, _HEADER.size)[0]
    end = 12 + length + len(rest)
    return _Header(matrices, color_type, depth_type, (cw, ch), (dw, dh), units, count, end)


def _read_index(stream: BinaryIO, header: _Header) -> _Index:
    """Pass over the frames up to the first that is not whole."""
    size = stream.seek(0, 2)
    offsets, heads = array("q"), bytearray()
    at = header.end
    while len(offsets) < min(header.count, _MOST_FRAMES):
        stream.seek(at)
        head = stream.read(_FRAME.itemsize)
        if len(head) < _FRAME.itemsize:
            break
        color, depth = _LENGTHS.unpack_from(head, _FRAME.itemsize - _LENGTHS.size)
        at += _FRAME.itemsize
        if max(color, depth) > IMAGE_BYTES or at + color + depth > size:
            break
        offsets.append(at)
        heads += head
        at += color + depth
    table = np.frombuffer(heads, _FRAME)
    return _Index(
        np.array(offsets, np.int64),
        table["lengths"].astype(np.int64),
        table["T"],
        table["times"][:, 0].astype(np.float64),
    )


def _cameras(header: _Header, file: Path) -> StatedCameras:
    color, T_rig_color, depth, T_rig_depth = header.matrices
    return StatedCameras(
        _lens(color, header.color_size, f"The color camera of {file}"),
        _lens(depth, header.depth_size, f"The depth camera of {file}"),
        invert(T_rig_color) @ T_rig_depth if is_pose(T_rig_color) and is_pose(T_rig_depth) else None,
    )


def _lens(K: NDArray[np.float64], size: Size, source: str) -> Lens | None:
    """None if the file states no camera (zeros)."""
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Lens(Calibration((fx, fy, cx, cy), size, source).camera(size)) if fx or fy else None


def _notice_cut_off(file: Path, whole: int, stated: int) -> Notice:
    return Notice(
        "images-left-out",
        f"{file} is cut off: it states {stated} frames, and {whole} are whole. These are used; copy the file again to "
        "have all.",
    )
