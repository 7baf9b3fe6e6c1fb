"""Turns CameraInfo into lenses, and transforms into the place of one camera beside the other.

Sources: sensor_msgs/CameraInfo, distortion_models.hpp, tf2_msgs/TFMessage, REP 105; librealsense's names of models.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.image_files import Size
from ...core.transforms import invert, is_rigid, quats_to_rotations
from ..cameras.camera_files import Calibration
from ..cameras.lenses import Lens

_BROWN = ("plumb_bob", "rational_polynomial", "brown_conrady", "modified_brown_conrady", "inverse_brown_conrady")
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt4")
_COUNTS = (4, 5, 8, 12, 14)  # numbers of coefficients that OpenCV accepts


def lens_of_info(info: Any, size: Size, rectified: bool, source: str) -> Lens | None:
    """The lens of images of ``size`` that a CameraInfo describes; None if it states no camera.

    rectified: whether the images are undistorted, so that P is their camera and D does not apply. Raises CaptureError.
    """
    K, P, D = (np.asarray(getattr(info, name, getattr(info, name.lower(), ())), np.float64) for name in "KPD")
    values = P[[0, 5, 2, 6]] if rectified and len(P) == 12 and P[0] > 0 else K[[0, 4, 2, 5]]
    if not values[:2].any():
        return None
    stated = int(info.width) or size[0], int(info.height) or size[1]
    values, stated = _reduced(info, values, stated)
    fx, fy, cx, cy = values.tolist()
    camera = Calibration((fx, fy, cx, cy), stated, source).camera(size)
    if rectified or not D.any():
        return Lens(camera)
    return _distorted(Lens(camera), D, str(info.distortion_model), source)


def _reduced(info: Any, values: NDArray[np.float64], size: Size) -> tuple[NDArray[np.float64], Size]:
    """Values and size after the part and the binning that the driver applies."""
    part, binning = info.roi, np.array((max(int(info.binning_x), 1), max(int(info.binning_y), 1)))
    whole = size
    if int(part.width) and int(part.height):
        values = values - (0, 0, int(part.x_offset), int(part.y_offset))
        whole = int(part.width), int(part.height)
    scale = np.tile(binning, 2)
    values = (values + (0, 0, 0.5, 0.5)) / scale - (0, 0, 0.5, 0.5) if (binning > 1).any() else values
    return values, (int(whole[0] // binning[0]), int(whole[1] // binning[1]))


def _distorted(lens: Lens, D: NDArray[np.float64], model: str, source: str) -> Lens:
    name = model.strip().lower().replace(" ", "_")
    count = next((count for count in _COUNTS if count >= len(D) or not D[count:].any()), 0)
    values = np.zeros(max(count, 4))
    values[: len(D[:count])] = D[:count]
    if not np.isfinite(D).all() or not count:
        raise CaptureError(f"{source} states {len(D)} coefficients of distortion, which are not those of a lens.")
    if name in _FISHEYE and count == 4:
        return Lens(lens.camera, tuple(values.tolist()), fisheye=True)
    if name in _BROWN:
        return Lens(lens.camera, tuple(values.tolist()))
    raise CaptureError(
        f"{source} states the distortion model {model!r}, which is not supported: record images that are rectified, or "
        "use plumb_bob, rational_polynomial or equidistant."
    )


def transform_matrix(transform: Any) -> NDArray[np.float64] | None:
    """(4, 4) of a geometry_msgs/Transform; None if it is no rigid transform."""
    q, t = transform.rotation, transform.translation
    quat_wxyz = np.array((q.w, q.x, q.y, q.z), np.float64)
    norm = float(np.linalg.norm(quat_wxyz))
    if not 0.5 < norm < 2:
        return None
    T = np.eye(4)
    T[:3, :3] = quats_to_rotations(quat_wxyz / norm)
    T[:3, 3] = t.x, t.y, t.z
    return T if is_rigid(T) else None


class FrameTree:
    """Frames that do not move relative to each other, from TFMessages. A pair that moves is left out."""

    def __init__(self) -> None:
        self._edges: dict[tuple[str, str], NDArray[np.float64] | None] = {}

    def add(self, messages: Iterable[Any]) -> None:
        """Take up the transforms of TFMessages."""
        for stamped in (stamped for message in messages for stamped in message.transforms):
            T = transform_matrix(stamped.transform)
            parent, child = str(stamped.header.frame_id).lstrip("/"), str(stamped.child_frame_id).lstrip("/")
            if T is not None:
                known = self._edges.setdefault((parent, child), T)
                if known is not None and np.abs(known - T).max() > 1e-4:
                    self._edges[parent, child] = None

    def find(self, target: str, source: str) -> NDArray[np.float64] | None:
        """(4, 4) T_target_source; None if nothing connects the frames."""
        steps: dict[str, list[tuple[str, NDArray[np.float64]]]] = {}
        for (parent, child), T in self._edges.items():
            if T is not None:
                steps.setdefault(parent, []).append((child, T))
                steps.setdefault(child, []).append((parent, invert(T)))
        reached = {target: np.eye(4)}
        waiting = [target]
        while waiting and source not in reached:
            at = waiting.pop()
            for name, T_at_name in steps.get(at, ()):
                if name not in reached:
                    reached[name] = reached[at] @ T_at_name
                    waiting.append(name)
        return reached.get(source)
