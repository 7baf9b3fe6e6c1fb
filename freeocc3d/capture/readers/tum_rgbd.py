"""Reads the TUM RGB-D benchmark, ICL-NUIM, and recordings with the same lists: rgb.txt and depth.txt, associations."""

from __future__ import annotations

import re
from pathlib import Path

from ...core.types import Intrinsics
from ..base import Options
from ..cameras.lenses import Lens
from ..files.name_matching import are_seconds
from ..files.paired_folders import find_folders, pair_images
from ..image_lists import find_lists, read_comments, read_lists
from ..paired_frames import PairedFrames
from ..poses.paired_poses import find_pose_file

REQUIRES: tuple[str, ...] = ()

UNITS_PER_METER = 5000.0
"""Depth units per meter of TUM's own recordings."""

_FREIBURG = re.compile(r"freiburg([123])")
_LENSES = {
    "1": Lens(Intrinsics(640, 480, 517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Lens(Intrinsics(640, 480, 520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": Lens(Intrinsics(640, 480, 535.4, 539.2, 320.1, 247.6)),
}
"""The published color cameras; depth is registered to their distorted images."""


class Reader(PairedFrames):
    """``associations.txt`` (``time path time path``, either order; also ``associate.txt`` and the like) pairs the
    images. Without it, ``rgb.txt`` and ``depth.txt`` (``time path``) do by the nearest time, or the names of the files
    where these are seconds. Timestamps are those of color. If they are not in the order of the names, the names tell
    the order, and frames are numbered.

    Comments that name TUM's freiburg1, 2 or 3 state the camera with its distortion, and 5000 units per meter. Otherwise
    both come from a file beside the lists (see ``camera_discovery``), or nothing states them. ``groundtruth.txt`` is
    optional: the pose of a frame is interpolated between neighbors within 0.1 s, or the nearest one within 0.02 s.

    Associations with depth first and frame numbers as times are ICL-NUIM's. Its poses are those of a camera with y up
    (fy = -480), and are converted to OpenCV axes. Its camera is 481.2, 480, 319.5, 239.5, which no file states.
    """

    format = "tum_rgbd"
    layout = "rgb.txt with depth.txt, or associations.txt"
    parts = ("rgb/*", "depth/*", "rgb.txt or associations.txt", "depth.txt or associations.txt")

    def __init__(self, path: Path, options: Options):
        lists, folders = find_lists(path), find_folders(path)
        is_icl_nuim = False
        if lists.usable or folders is None:
            frames, is_icl_nuim = read_lists(lists, path, options.depth)
        else:
            frames = pair_images(folders, path, options.depth)
        named = _FREIBURG.search(read_comments((lists.color, lists.depth, find_pose_file(path))))
        super().__init__(
            path,
            options,
            frames,
            _LENSES[named[1]] if named else None,
            UNITS_PER_METER if named else None,
            mirrored=is_icl_nuim,
        )

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        if find_lists(path).usable:
            return not (path / "intrinsic").is_dir()  # as ScanNet's
        folders = find_folders(path)
        return folders is not None and are_seconds(folders.color_names)
