"""The result of structure from motion, as plain data."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...capture.base import NOMINAL_DEPTH
from ...capture.cameras.lenses import Lens
from ...capture.cameras.undistortion import Rectified
from ...core.arrays import read_arrays, write_arrays
from ...core.types import Intrinsics
from ...core.warnings import Notice

_EXPECTED = {
    "T_world_cam": ("f", 3), "camera": ("f", 1), "points": ("f", 2), "seen_frame": ("i", 1), "seen_point": ("i", 1),
    "fisheye": ("b", 0), "metric": ("b", 0), "apart": ("b", 1), "chosen": ("b", 1), "warnings": ("U", 2),
}  # fmt: skip

_OF_LENS = ("camera", "fisheye")


@dataclass(frozen=True)
class Reconstruction:
    """Poses and sparse points of a scan, from structure from motion or from an existing model.

    T_world_cam: (N, 4, 4) float64, row n = frame n of the capture, NaN without a pose.
    lens: of all frames.  points: (P, 3) float32 world.
    seen_frame, seen_point: (O,) int32; frame ``seen_frame[i]`` sees point ``seen_point[i]``.
    metric: whether the world's unit is the meter.
    apart: (N,) whether the frame is in another, unconnected model.
    chosen: (N,) whether the frame was selected for reconstruction.  warnings: for the user.
    """

    T_world_cam: NDArray[np.float64]
    lens: Lens
    points: NDArray[np.float32]
    seen_frame: NDArray[np.int32]
    seen_point: NDArray[np.int32]
    metric: bool
    apart: NDArray[np.bool_]
    chosen: NDArray[np.bool_]
    warnings: tuple[Notice, ...] = field(default=())

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """(N,) whether each frame has a pose."""
        return np.asarray(np.isfinite(self.T_world_cam).all(axis=(1, 2)))

    @cached_property
    def rectified(self) -> Rectified:
        """Resamples frames to a pinhole camera."""
        return Rectified(self.lens, None)

    def depths(self) -> NDArray[np.float64]:
        """(O,) depth of each observation: the point's z in the frame's camera."""
        T = self.T_world_cam[self.seen_frame]
        moved = self.points[self.seen_point].astype(np.float64) - T[:, :3, 3]
        return np.asarray((moved * T[:, :3, 2]).sum(axis=1))

    def scaled(self, scale: float) -> Reconstruction:
        """The reconstruction with every length multiplied by ``scale``."""
        T_world_cam = self.T_world_cam.copy()
        T_world_cam[:, :3, 3] *= scale
        return replace(self, T_world_cam=T_world_cam, points=self.points * np.float32(scale))

    def normalized(self) -> Reconstruction:
        """The reconstruction scaled to a median depth of ``NOMINAL_DEPTH``, unless its scale is known."""
        return self if self.metric else self.scaled(NOMINAL_DEPTH / float(np.median(self.depths())))

    def save(self, path: Path) -> None:
        """Write an .npz file, completely or not at all. Raises OSError."""
        camera = self.lens.camera
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *self.lens.distortion)
        arrays: dict[str, Any] = {name: getattr(self, name) for name in _EXPECTED if name not in _OF_LENS}
        arrays["warnings"] = np.array(self.warnings, "U").reshape(-1, 2)
        write_arrays(path, {**arrays, "camera": np.array(numbers), "fisheye": np.bool_(self.lens.fisheye)})

    @classmethod
    def load(cls, path: Path) -> Reconstruction:
        """The inverse of ``save``. Raises MapError for a damaged file."""
        arrays = read_arrays(path, _EXPECTED)
        width, height, fx, fy, cx, cy, *distortion = arrays.pop("camera").tolist()
        lens = Lens(Intrinsics(int(width), int(height), fx, fy, cx, cy), tuple(distortion), bool(arrays.pop("fisheye")))
        metric, warnings = bool(arrays.pop("metric")), tuple(Notice(*row) for row in arrays.pop("warnings").tolist())
        return cls(lens=lens, metric=metric, warnings=warnings, **arrays)
