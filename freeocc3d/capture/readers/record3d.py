"""Reads captures of the iOS app Record3D: an .r3d file, the same unpacked, or an export as EXR and images.

Sources: the converters of nerfstudio (record3d_utils.py) and instant-ngp (record3d2nerf.py), and the description of
``metadata`` in RGBD-Video-iPhone12Pro.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError
from ...core.image_files import MOST_PIXELS, Size
from ...core.regular_files import IMAGE_BYTES
from ...core.typed_documents import InvalidDocument, as_type, parse_json
from ...core.warnings import Notice
from ..base import Options
from ..cameras.camera_files import Calibration, Number, PositiveNumber
from ..cameras.lenses import Lens
from ..cameras.rigs import Rig, StatedCameras, build_rig
from ..files.number_files import JSON_BYTES
from ..files.numbered_files import list_folder
from ..files.packed_files import FolderFiles, PackedFiles, ZipFiles, is_zip
from ..frame_files import notice_left_out
from ..images.depth_decoding import METERS, RawDepth, read_depth_size, read_raw_depth
from ..images.image_decoding import decode_color_bytes, encoded_size
from ..images.lzfse_blocks import lzfse_size, unpack_lzfse
from ..poses.frame_poses import ascending_times, poses_of
from ..rgbd_frames import Registration, RgbdFrames, normalize_confidence

REQUIRES: tuple[str, ...] = ()

_NUMBERED = re.compile(r"(\d{1,9})\.(jpe?g|png|depth|conf|exr)", re.IGNORECASE)
_COLORS, _DEPTHS, _CONFIDENCES = ("jpg", "jpeg", "png"), ("depth", "exr"), ("conf",)

_Pose = tuple[Number, Number, Number, Number, Number, Number, Number]


class _Metadata(msgspec.Struct, rename={"per_frame": "perFrameIntrinsicCoeffs", "times": "frameTimestamps"}):
    """w, h: size of the color that the cameras are for.  dw, dh: of the depth.  K: column-major.  poses: qx qy qz qw
    tx ty tz, camera to world.  per_frame: fx fy cx cy.  times: seconds of any clock.  Lists have an entry
    per frame number."""

    w: PositiveNumber
    h: PositiveNumber
    K: Annotated[tuple[Number, ...], Meta(min_length=9, max_length=9)] | None = None
    dw: int | None = None
    dh: int | None = None
    fps: PositiveNumber | None = None
    poses: list[_Pose] | None = None
    per_frame: list[Annotated[list[Number], Meta(min_length=4)]] | None = None
    times: list[float] | None = None


@dataclass(frozen=True)
class _Layout:
    """Where the files of a capture lie: the metadata, and the folders of color and of depth with its confidence."""

    files: PackedFiles
    metadata: str
    color: str
    depth: str


@dataclass(frozen=True)
class _Entry:
    """The files of one frame, by name; None = none."""

    number: int
    color: str
    depth: str | None
    confidence: str | None


class Reader(RgbdFrames):
    """Depth is float32 meters, packed with LZFSE or as EXR; its size is stated, or follows from the count of its bytes
    and the shape of the color. Confidence is 0, 1, 2. Cameras are for the color; ``perFrameIntrinsicCoeffs`` wins over
    ``K``. Poses are those of ARKit's cameras. Frames that lack color or depth are left out, with a warning.

    Raises CaptureError for missing or damaged metadata, and for a capture without depth unless ``capture.depth`` is
    false.
    """

    format = "record3d"
    layout = "an .r3d file of Record3D, a folder with metadata and rgbd/, or with metadata.json, rgb/ and depth/*.exr"
    reads_files = True

    def __init__(self, path: Path, options: Options):
        layout = _find(path)
        if layout is None:
            if path.is_file() and not is_zip(path):
                raise CaptureError(f"{path} is no capture of Record3D: it is no zip archive. Copy or export it again.")
            raise CaptureError(
                f"{path} is no capture of Record3D: it has no metadata beside rgbd/, or rgb/ and depth/."
            )
        self._files = layout.files
        self._stated = metadata = _read_metadata(layout)
        self._entries, self.warnings = _choose(layout, path, options)
        color_size = _first(self._entries, self._size_of_color, path)
        depth_size = (
            _first(self._entries, lambda one: self._size_of_depth(one, color_size), path) if options.depth else None
        )
        self._build = functools.lru_cache(maxsize=16)(
            lambda camera: build_rig(StatedCameras(camera), options, color_size, depth_size)
        )
        self.intrinsics_known = self.focal_stated = self._build(self._lens(self._entries[0].number))[1]
        self._color_size, self._depth_size = color_size, depth_size
        poses = np.array(metadata.poses or [], np.float64).reshape(-1, 7)
        self._poses = poses_of(poses[:, 4:], poses[:, :4], opengl=True)
        super().__init__(path, options, _times(metadata, [one.number for one in self._entries]), METERS)
        Registration(self.rig(0))  # raises CaptureError for a rig of too large images

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        if path.is_file() and path.suffix.lower() == ".r3d":
            return True
        try:
            return _find(path) is not None
        except CaptureError:  # another archive, which is damaged
            return False

    def stored_color(self, index: int) -> NDArray[np.uint8]:
        name = self._entries[index].color
        return decode_color_bytes(self._files.read(name, IMAGE_BYTES), self._files.source(name), self._color_size)

    def stored_depth(self, index: int) -> RawDepth | None:
        name, size = self._entries[index].depth, self._depth_size
        if name is None or size is None:
            return None
        if _is_exr(name):
            return read_raw_depth(self._files.source(name), size)
        return np.frombuffer(self._unpacked(name, size, 4), "<f4").astype(np.float32, copy=False).reshape(size[::-1])

    def stored_confidence(self, index: int) -> NDArray[np.uint8] | None:
        name, size = self._entries[index].confidence, self._depth_size
        if name is None or size is None:
            return None
        return normalize_confidence(np.frombuffer(self._unpacked(name, size, 1), np.uint8).reshape(size[::-1]))

    def rig(self, index: int) -> Rig:
        try:
            return self._build(self._lens(self._entries[index].number))[0]
        except CaptureError as error:
            raise FrameError(str(error)) from error

    def name(self, index: int) -> str:
        return self._entries[index].color.rpartition("/")[2]

    def pose(self, index: int) -> NDArray[np.float64] | None:
        number = self._entries[index].number
        return self._poses[number] if number < len(self._poses) else None

    def _lens(self, number: int) -> Lens | None:
        """The color camera of a frame. Raises CaptureError."""
        metadata, size = self._stated, (round(self._stated.w), round(self._stated.h))
        per_frame, K = metadata.per_frame or [], metadata.K
        if number < len(per_frame) and per_frame[number][0] > 0:
            fx, fy, cx, cy = per_frame[number][:4]
        elif K is not None:
            fx, fy, cx, cy = K[0], K[4], K[6], K[7]
        else:
            return None
        return Lens(Calibration((fx, fy, cx, cy), size, f"The metadata of {self._files.path}").camera(size))

    def _unpacked(self, name: str, size: Size, item_bytes: int) -> bytes:
        """The values of a packed image of that size. Raises FrameError."""
        source, wanted = self._files.source(name), size[0] * size[1] * item_bytes
        data = unpack_lzfse(self._files.read(name, IMAGE_BYTES), source, wanted)
        if len(data) != wanted:
            raise FrameError(f"{source} holds {len(data)} bytes instead of {size[0]} x {size[1]} x {item_bytes}.")
        return data

    def _size_of_color(self, entry: _Entry) -> Size:
        return encoded_size(self._files.read(entry.color, IMAGE_BYTES), self._files.source(entry.color))

    def _size_of_depth(self, entry: _Entry, color_size: Size) -> Size:
        assert entry.depth is not None
        source = self._files.source(entry.depth)
        if _is_exr(entry.depth):
            return read_depth_size(source)
        count, rest = divmod(lzfse_size(self._files.read(entry.depth, IMAGE_BYTES), source), 4)
        width, height = self._stated.dw or 0, self._stated.dh or 0
        if width * height != count or rest:
            width, height = _shape_of(count, color_size[0] / color_size[1]) if 0 < count <= MOST_PIXELS else (0, 0)
        if width * height != count or rest or not count:
            raise FrameError(f"{source} holds {4 * count + rest} bytes, which are no image of float32.")
        return width, height


def _is_exr(name: str) -> bool:
    return name.lower().endswith(".exr")


def _find(path: Path) -> _Layout | None:
    """The layout of a file or folder; None if it is no capture of Record3D. Raises CaptureError for a damaged file."""
    if path.is_dir():
        names = set(list_folder(path))
        if "metadata" in names and "rgbd" in names:
            return _Layout(FolderFiles(path), "metadata", "rgbd", "rgbd")
        for files in (FolderFiles(path), FolderFiles(path / "EXR_RGBD")):
            if "metadata.json" in files.list("") and any(map(_is_exr, files.list("depth"))) and files.list("rgb"):
                return _Layout(files, "metadata.json", "rgb", "depth")
        return None
    if not is_zip(path):
        return None
    archive = ZipFiles(path)
    if "metadata" not in archive.list("") or not archive.list("rgbd"):
        return None
    return _Layout(archive, "metadata", "rgbd", "rgbd")


def _read_metadata(layout: _Layout) -> _Metadata:
    source = layout.files.source(layout.metadata)
    try:
        return as_type(parse_json(layout.files.read(layout.metadata, JSON_BYTES), finite=True), _Metadata)
    except FrameError as error:
        raise CaptureError(str(error)) from error
    except InvalidDocument as error:
        raise CaptureError(f"{source} is not usable: {error}. Export the capture again.") from error


def _choose(layout: _Layout, path: Path, options: Options) -> tuple[list[_Entry], tuple[Notice, ...]]:
    """The frames that have what is needed, by ascending number, and a warning about the others. Raises CaptureError."""
    color = _list(layout, layout.color, _COLORS)
    depth = _list(layout, layout.depth, _DEPTHS) if options.depth else {}
    confidence = _list(layout, layout.depth, _CONFIDENCES) if options.depth else {}
    if not color:
        raise CaptureError(f"{path} holds no color images in {layout.color}/.")
    if options.depth and not color.keys() & depth.keys():
        raise CaptureError(f"{path} holds no depth for its color: export it with depth, or set capture.depth=false.")
    numbers = sorted(color.keys() | depth.keys())
    kept = [n for n in numbers if n in color and (n in depth or not options.depth)]
    entries = [_Entry(n, color[n], depth.get(n), confidence.get(n)) for n in kept]
    if len(kept) == len(numbers):
        return entries, ()
    first = min(set(numbers) - set(kept))
    missing = "depth" if first in color else "color"
    return entries, (notice_left_out(len(numbers) - len(kept), len(numbers), path, str(first), f"has no {missing}"),)


def _list(layout: _Layout, folder: str, suffixes: Sequence[str]) -> dict[int, str]:
    """The files of a folder by the number that is their name."""
    found = {}
    for name in layout.files.list(folder):
        if (match := _NUMBERED.fullmatch(name)) and match[2].lower() in suffixes:
            found[int(match[1])] = f"{folder}/{name}"
    return found


def _first(entries: Sequence[_Entry], read: Callable[[_Entry], Size], path: Path) -> Size:
    """What ``read`` gives for the first frame that it can read. Raises CaptureError if it can read none."""
    reason = ""
    for entry in entries:
        try:
            return read(entry)
        except FrameError as error:
            reason = reason or str(error)
    raise CaptureError(f"No frame of {path} can be read: {reason}")


def _shape_of(count: int, aspect: float) -> Size:
    """Width and height of ``count`` pixels whose ratio is nearest to ``aspect``."""
    sides = np.arange(1, math.isqrt(count) + 1)
    sides = sides[count % sides == 0]
    widths = np.concatenate((sides, count // sides))
    width = int(widths[np.argmin(np.abs(np.log(widths / (count // widths) / aspect)))])
    return width, count // width


def _times(metadata: _Metadata, numbers: Sequence[int]) -> NDArray[np.float64]:
    """(N,) seconds: stated, or by the rate."""
    stated = metadata.times or []
    if numbers[-1] < len(stated):
        return ascending_times([stated[number] for number in numbers])
    return np.array(numbers, np.float64) / (metadata.fps or 1.0)
