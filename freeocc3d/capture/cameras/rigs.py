"""The color and the depth camera that took a frame, from what a format states about them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core.image_files import Size
from ..base import Options
from .camera_files import guess_camera, read_given_calibration, rescale_camera
from .lenses import Lens

Transform = tuple[tuple[float, ...], ...]
"""The rows of a (4, 4) transform; unlike an array it can be compared and hashed."""


@dataclass(frozen=True)
class Rig:
    """The cameras that took the stored color and depth of a frame. T_color_depth: rows of the (4, 4) transform from the
    depth to the color camera frame; None if the two coincide."""

    color: Lens
    depth: Lens
    T_color_depth: Transform | None = None


@dataclass(frozen=True)
class StatedCameras:
    """What a format states about a rig; None = nothing. T_color_depth: (4, 4) depth to color camera frame."""

    color: Lens | None = None
    depth: Lens | None = None
    T_color_depth: NDArray[np.float64] | None = None


def build_rig(stated: StatedCameras, options: Options, color_size: Size, depth_size: Size | None) -> tuple[Rig, bool]:
    """The rig of stored images of these sizes, and whether the color camera is known.

    ``capture.intrinsics`` and ``capture.focal`` replace the color camera. Cameras for other sizes of the same view are
    rescaled. A camera that is not stated is the other one, seen with other pixels; without any, it is a guess.
    depth_size: None = no depth. Raises CaptureError if a camera cannot have taken the images.
    """
    given = read_given_calibration(options)
    color = Lens(given.camera(color_size)) if given else stated.color or stated.depth
    known = color is not None
    color = _resized(color or Lens(guess_camera(color_size)), color_size)
    if depth_size is None:
        return Rig(color, color), known
    rows = None if stated.T_color_depth is None else tuple(map(tuple, stated.T_color_depth.tolist()))
    return Rig(color, _resized(stated.depth or color, depth_size), rows), known


def _resized(lens: Lens, size: Size) -> Lens:
    if (lens.camera.width, lens.camera.height) == size:
        return lens
    return replace(lens, camera=rescale_camera(lens.camera, size))
