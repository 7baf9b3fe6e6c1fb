"""Reads BundleFusion and 3RScan: frame-000000.color.jpg, .depth.png or .pgm, .pose.txt, and info.txt or _info.txt."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ..base import Options
from ..cameras.camera_documents import CameraDocument, read_cameras
from ..cameras.camera_files import check_pose_files, read_pose
from ..cameras.rigs import StatedCameras, build_rig
from ..files.numbered_files import has_file, list_numbered
from ..image_pairs import ImagePairs, pair_files
from .seven_scenes import COLOR, DEPTH, POSE

REQUIRES: tuple[str, ...] = ()

INFO = ("info.txt", "_info.txt")
FOLDERS = ("", "sequence")


class Reader(ImagePairs):
    """``info.txt`` states both cameras (``m_calibrationColorIntrinsic``, ``m_calibrationDepthIntrinsic``, for the sizes
    ``m_colorWidth`` …), their poses in the rig (``m_calibrationColorExtrinsic`` …), and ``m_depthShift``, the depth
    units per meter. Images lie beside it or in ``sequence/``. Poses are optional and camera-to-world; -inf means no
    pose. Depth of 0 is no measurement.

    Sources: the data pages of BundleFusion and 3RScan.
    """

    format = "bundlefusion"
    layout = "frame-N.color.jpg with frame-N.depth.png (or .pgm) and info.txt (or _info.txt), or these in sequence/"
    parts = ("frame-*.color.jpg", "frame-*.depth.png or frame-*.depth.pgm", "info.txt or _info.txt")

    def __init__(self, path: Path, options: Options):
        folder = _find_folder(path)
        if folder is None:
            raise CaptureError(f"{path} holds no images of this format beside an info.txt: expected {self.layout}.")
        self._folder = folder
        pairs = pair_files(list_numbered(folder, COLOR), list_numbered(folder, DEPTH), folder, options)
        document = _read_info(path, folder, options)
        stated = StatedCameras(
            document.color.lens(pairs.color_size) if document.color else None,
            document.depth.lens(pairs.depth_size) if document.depth and options.depth else None,
            document.T_color_depth,
        )
        rig, self.intrinsics_known = build_rig(
            stated, options, pairs.color_size, pairs.depth_size if options.depth else None
        )
        self.focal_stated = self.intrinsics_known
        super().__init__(path, options, pairs, rig, document.units_per_meter)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return _find_folder(path) is not None

    def pose(self, index: int) -> NDArray[np.float64] | None:
        path = self._pose_files.get(self._pairs.numbers[index])
        return None if path is None else read_pose(path)

    @functools.cached_property
    def _pose_files(self) -> dict[int, Path]:
        files = list_numbered(self._folder, POSE)
        check_pose_files(list(files.values()), str(self._folder))
        return files


def _find_folder(path: Path) -> Path | None:
    """The folder of the images, if there is an info file too; None otherwise."""
    folder = next((path / name for name in FOLDERS if has_file(path / name, COLOR)), None)
    return folder if folder is not None and _find_info(path, folder) is not None else None


def _find_info(path: Path, folder: Path) -> Path | None:
    places = (place / name for place in (folder, path) for name in INFO)
    return next((file for file in places if file.is_file()), None)


def _read_info(path: Path, folder: Path, options: Options) -> CameraDocument:
    """What the info file states. Raises CaptureError if it states no camera, and none is given."""
    file = _find_info(path, folder)
    found = read_cameras(file) if file is not None else None
    if found is None or not (found.color or found.depth):
        if not (options.intrinsics or options.focal):
            raise CaptureError(
                f"{file} states no camera: it must hold m_calibrationColorIntrinsic and m_calibrationDepthIntrinsic, "
                "of 4 x 4 numbers each. Correct it, or give capture.intrinsics."
            )
        return found or CameraDocument()
    return found
