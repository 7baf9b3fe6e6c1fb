"""Represents the camera models of COLMAP, OpenCV and nerfstudio as one type.

Sources: COLMAP's "Camera models", nerfstudio's "Data conventions", OpenCV's "Camera calibration and 3D reconstruction"
and "Fisheye camera model". The radial models of all three are OpenCV's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ...core.errors import CaptureError
from ...core.types import Intrinsics

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
BROWN_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Radial and tangential distortion. Each model has some of the eight coefficients, or all."""
FISHEYE_MODELS = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
MODELS = (*PINHOLE_MODELS, *BROWN_MODELS, *FISHEYE_MODELS)

_BROWN_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_BROWN_COUNTS = (0, 4, 5, 8)  # numbers of coefficients that OpenCV accepts
_FISHEYE_ORDER = ("k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class Lens:
    """A camera and its distortion, in OpenCV's order: k1 k2 p1 p2, then k3 k4 k5 k6 if used; for a fisheye k1 k2 k3 k4.
    Without coefficients, or with all zero, it is a pinhole camera, unless it is a fisheye."""

    camera: Intrinsics
    distortion: tuple[float, ...] = ()
    fisheye: bool = False


def lens_of(model: str, camera: Intrinsics, coefficients: Mapping[str, float], source: str) -> Lens:
    """The lens of a named camera model with named coefficients (``k`` means ``k1``); missing coefficients are 0.

    source: the file that states them, for messages. Raises CaptureError for a model that is not in ``MODELS``, or for a
    coefficient that the model lacks.
    """
    if model not in MODELS:
        raise CaptureError(
            f"{source} states the camera model {model}, which is not supported: undistort the images first (colmap "
            f"image_undistorter), or use one of {', '.join(MODELS)}."
        )
    order = _FISHEYE_ORDER if model in FISHEYE_MODELS else _BROWN_ORDER if model in BROWN_MODELS else ()
    stated = {"k1" if name == "k" else name: float(value) for name, value in coefficients.items() if value}
    allowed = order if model != "OPENCV" else _BROWN_ORDER[:5]
    if strange := sorted(set(stated) - set(allowed)):
        raise CaptureError(
            f"{source} states {strange[0]} of the camera model {model}, which is not read: undistort the images first."
        )
    values = tuple(stated.get(name, 0.0) for name in order)
    if model in FISHEYE_MODELS:
        return Lens(camera, values, fisheye=True)
    shortest = next((count for count in _BROWN_COUNTS if not any(values[count:])), 0)
    return Lens(camera, values[:shortest])
