"""Reads raw data of the iOS app Polycam: keyframes/ with images, depth, confidence and a camera file each.

Sources: the description and the converters of PolyCam/polyform, and nerfstudio's polycam_utils.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.image_files import Size
from ...core.warnings import Notice
from ..base import Options
from ..cameras.camera_files import Calibration, Number, PositiveNumber, is_pose, read_json
from ..cameras.lenses import Lens
from ..cameras.rigs import StatedCameras, build_rig
from ..files.numbered_files import has_file, list_numbered
from ..frame_files import FileFrames, FrameFiles, notice_left_out, read_first_depth_size, read_first_size
from ..images.depth_decoding import MILLIMETERS
from ..poses.frame_poses import ascending_times
from ..rgbd_frames import Registration

REQUIRES: tuple[str, ...] = ()

KEYFRAMES = "keyframes"
IMAGE, DEPTH, CAMERA = r"(\d+)\.(?:jpe?g|png)", r"(\d+)\.png", r"(\d+)\.json"

_SHORTEST_STEP = 10_000
"""Names count microseconds if keyframes are at least this far apart, else milliseconds: a scan has fewer than 100
keyframes per second, and more than one per 10 s."""

_ROWS = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]


class _Camera(msgspec.Struct):
    """A camera file. t_rc: camera to world, of a camera that looks along -z with y up, as those of ARKit do."""

    fx: PositiveNumber
    fy: PositiveNumber
    cx: Number
    cy: Number
    width: Annotated[int, Meta(gt=0, le=1_000_000)]
    height: Annotated[int, Meta(gt=0, le=1_000_000)]
    t_00: Number
    t_01: Number
    t_02: Number
    t_03: Number
    t_10: Number
    t_11: Number
    t_12: Number
    t_13: Number
    t_20: Number
    t_21: Number
    t_22: Number
    t_23: Number

    def pose(self) -> NDArray[np.float64] | None:
        """(4, 4) T_world_cam in OpenCV axes; None if it is not rigid."""
        T = np.eye(4)
        T[:3] = [[getattr(self, name) for name in row] for row in _ROWS]
        T[:, 1:3] *= -1
        return T if is_pose(T) else None


class Reader(FileFrames):
    """Depth is uint16 millimeters, confidence 0, 127, 255; file names are times. Each frame has its own camera, in the
    pixels of its color, that the depth shares with other pixels.

    ``corrected_images`` and ``corrected_cameras``, which exist if Polycam closed loops, replace ``images`` and
    ``cameras``: frames that only the latter have are used without a pose, because the two are not in one world. Frames
    that lack an image, depth or camera are left out, with a warning. The path is ``keyframes`` or the folder above.
    """

    format = "polycam"
    layout = f"{KEYFRAMES}/ with images/, cameras/*.json and depth/"
    parts = ("keyframes/images", "keyframes/depth", "keyframes/cameras")

    def __init__(self, path: Path, options: Options):
        root = _find(path) or path
        color, cameras, corrected = _sources(root)
        depth = list_numbered(root / "depth", DEPTH) if options.depth else {}
        confidence = list_numbered(root / "confidence", DEPTH) if options.depth else {}
        if not color or not cameras:
            raise CaptureError(f"{root} holds {len(color)} images and {len(cameras)} camera files: both are needed.")
        if options.depth and not depth:
            raise CaptureError(f"{root} holds no depth: export raw data of a LiDAR scan, or set capture.depth=false.")
        needed = {"image": color, "camera file": cameras, **({"depth image": depth} if options.depth else {})}
        kept = sorted(set.intersection(*map(set, needed.values())))
        if not kept:
            raise CaptureError(f"No keyframe of {root} has {', '.join(needed)}: their names must be equal.")
        color_size = read_first_size([color[n] for n in kept], root)
        depth_size = read_first_depth_size([depth[n] for n in kept], root) if options.depth else None
        frames = []
        for number, time in zip(kept, _times(kept).tolist(), strict=True):
            camera = read_json(cameras[number], _Camera)
            rig, _ = build_rig(_stated(camera, cameras[number]), options, color_size, depth_size)
            T_world_cam = camera.pose() if number in corrected else None
            frames.append(FrameFiles(color[number], depth.get(number), rig, time, T_world_cam, confidence.get(number)))
        super().__init__(path, options, frames, MILLIMETERS)
        Registration(frames[0].rig)  # raises CaptureError for a rig of too large images
        self.warnings = _notices(needed, kept, root)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return _find(path) is not None


def _find(path: Path) -> Path | None:
    """The folder of keyframes that ``path`` is or holds."""
    for root in (path / KEYFRAMES, path):
        for prefix in ("", "corrected_"):
            if has_file(root / f"{prefix}cameras", CAMERA) and has_file(root / f"{prefix}images", IMAGE):
                return root
    return None


def _sources(root: Path) -> tuple[dict[int, Path], dict[int, Path], set[int]]:
    """The images and the camera files to use, by number, and the numbers of those whose poses are in one world."""
    color, cameras = list_numbered(root / "images", IMAGE), list_numbered(root / "cameras", CAMERA)
    better, placed = list_numbered(root / "corrected_images", IMAGE), list_numbered(root / "corrected_cameras", CAMERA)
    corrected = better.keys() & placed.keys()
    if not corrected:
        return color or better, cameras or placed, set(cameras or placed)
    for number in corrected:
        color[number], cameras[number] = better[number], placed[number]
    return color, cameras, corrected


def _stated(camera: _Camera, file: Path) -> StatedCameras:
    size: Size = (camera.width, camera.height)
    return StatedCameras(Lens(Calibration((camera.fx, camera.fy, camera.cx, camera.cy), size, str(file)).camera(size)))


def _times(numbers: Sequence[int]) -> NDArray[np.float64]:
    """(N,) seconds from the first keyframe. The numbers are exact; floats of all seconds since a start are not."""
    since = np.array([number - numbers[0] for number in numbers], np.float64)
    per_second = 1e6 if len(since) > 1 and np.median(np.diff(since)) >= _SHORTEST_STEP else 1e3
    return ascending_times(since / per_second)


def _notices(needed: Mapping[str, Mapping[int, Path]], kept: Sequence[int], root: Path) -> tuple[Notice, ...]:
    every = {number for files in needed.values() for number in files}
    if len(kept) == len(every):
        return ()
    first = min(every - set(kept))
    missing = next(name for name, files in needed.items() if first not in files)
    return (notice_left_out(len(every) - len(kept), len(every), root, str(first), f"has no {missing}"),)
