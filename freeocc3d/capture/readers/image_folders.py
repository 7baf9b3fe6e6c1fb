"""Reads color and depth images in two folders, or in one: Open3D, Redwood, RTAB-Map, RealSense and own recordings."""

from __future__ import annotations

from pathlib import Path

from ...core.errors import CaptureError
from ..base import Options
from ..files.paired_folders import find_folders, pair_images
from ..paired_frames import PairedFrames

REQUIRES: tuple[str, ...] = ()


class Reader(PairedFrames):
    """Color lies in ``rgb/``, ``color/``, ``image/`` or a folder of a similar name, depth in ``depth/`` or a similar
    one, in any case; or both in one folder, where depth files have "depth" in their names. Images of one frame have the
    same number in their names, or times that differ by less than half a frame interval: seconds, milli-, micro- or
    nanoseconds, or Redwood's ``NUMBER-MICROSECONDS``. Images without a partner are left out with a warning.

    The camera comes from a file of any usual form in the folder, in ``intrinsic/`` or a similar folder, or in the
    parent (see ``camera_discovery``), with its distortion. Depth is registered to color unless the file states a depth
    camera. The depth unit is that of such a file; otherwise it is not stated. Optional: ``confidence/`` (0, 1, 2; 0,
    50, 100 or 0, 127, 255), ``pose/`` with 4 x 4 matrices, or a trajectory such as ``trajectory.log``, ``traj.txt``,
    ``poses.txt`` or ``groundtruth.txt``, with camera-to-world poses in OpenCV axes.
    """

    format = "image_folders"
    layout = "rgb/, color/ or image/ with depth/ (any names with equal numbers or near times)"
    general = True

    def __init__(self, path: Path, options: Options):
        folders = find_folders(path)
        if folders is None:
            raise CaptureError(
                f"{path} holds no color images beside depth images: put color in {path / 'color'} and depth in "
                f"{path / 'depth'}, with equal numbers in the names."
            )
        super().__init__(path, options, pair_images(folders, path, options.depth), pose_folder=folders.poses)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return find_folders(path) is not None
