"""Shows a map while it is made: points of the keyframes so far, placed by their poses of now, as colored voxels."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.transforms import back_project, transform
from ..core.types import Gaussians, Trajectory
from ..core.voxel_keys import pack_voxels, unpack_voxels
from ..storage.live_snapshot import Snapshot, is_watched, write_snapshot
from ..tracking.upright.up_direction import estimate_camera_up

if TYPE_CHECKING:
    from .mapper import Mapper

_LOOK_S = 1.0  # between two looks whether somebody watches
_PAUSE_S, _SHARE = 2.0, 0.04  # least time between snapshots; most of the run's time that they take
_POINTS = 5000  # of a keyframe
_NEW = 25  # keyframes that are read for one snapshot: a viewer that comes late catches up over several
_LEAST = 2  # points of a voxel that is shown
_KEY_LIMIT = 1 << 20  # voxel indices that ``voxel_keys`` packs


class LiveSnapshots:
    """Writes snapshots of a run into its work folder while somebody watches. Otherwise it costs a look at a file each
    second."""

    def __init__(self, mapper: Mapper, folder: Path):
        self._mapper, self._folder = mapper, folder
        self._points: dict[int, tuple[NDArray[np.float64], NDArray[np.uint8]]] = {}
        self._next = 0.0

    def offer(self, stage: str, gaussians: Gaussians | None = None) -> None:
        """Write a snapshot if it is time for one. stage: what the run does, in words.  gaussians: shown in place of the
        keyframes' points. A snapshot that cannot be written is left out. Raises OSError of a keyframe that could not
        be written before, as ``Mapper.add`` does."""
        now = time.monotonic()
        if gaussians is None and now < self._next:
            return
        self._next = now + _LOOK_S
        if not is_watched(self._folder):
            return
        with contextlib.suppress(FreeOccError):  # who watches must not end the run
            taken = self._take(stage, gaussians)
            with contextlib.suppress(OSError):
                write_snapshot(self._folder, taken)
        took = time.monotonic() - now
        self._next = time.monotonic() + max(_PAUSE_S, took / _SHARE)

    def _take(self, stage: str, gaussians: Gaussians | None) -> Snapshot:
        trajectory = self._mapper.trajectory()
        size = self._mapper.settings.occupancy.voxel_size
        if gaussians is None:
            points, colors = self._place(trajectory)
        else:
            points, colors = gaussians.means.astype(np.float64), gaussians.colors
        voxels, mean = color_voxels(points - self._mapper.origin, colors, size, 1 if gaussians is not None else _LEAST)
        return Snapshot(
            stage, self._mapper.upright is not None, self._mapper.tracker.metric, self._find_view(trajectory), size,
            self._mapper.origin, voxels, mean,
            trajectory.T_world_cam[trajectory.has_pose][:, :3, 3].astype(np.float32),
        )  # fmt: skip

    def _place(self, trajectory: Trajectory) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Returns the points of the keyframes, anchored in their cameras, where these stand now."""
        mapped = self._mapper.mapped(trajectory)
        new = [row for row, index in enumerate(trajectory.keyframes.tolist()) if index not in self._points][:_NEW]
        for row in new:
            frame = mapped[row]
            height, width = frame.depth_m.shape
            step = max(1, int(np.sqrt(height * width / _POINTS)))
            v, u = np.nonzero(frame.depth_m[::step, ::step])
            pixels = np.stack((u, v), axis=1) * float(step)
            depth = frame.depth_m[::step, ::step][v, u].astype(np.float64)
            self._points[frame.index] = (
                back_project(pixels, depth, frame.intrinsics), frame.color[::step, ::step][v, u],
            )  # fmt: skip
        parts = [
            (transform(T, self._points[index][0]), self._points[index][1])
            for index, T in zip(trajectory.keyframes.tolist(), trajectory.T_world_keyframe, strict=True)
            if index in self._points
        ]
        points = np.concatenate([np.zeros((0, 3)), *(part[0] for part in parts)])
        return points, np.concatenate([np.zeros((0, 3), np.uint8), *(part[1] for part in parts)])

    def _find_view(self, trajectory: Trajectory) -> NDArray[np.float64]:
        T = np.eye(4)
        if self._mapper.upright is None and len(trajectory.keyframes):
            up, _ = estimate_camera_up(trajectory.T_world_keyframe)
            x = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
            x /= np.linalg.norm(x)
            T[:3, :3] = np.stack((x, np.cross(up, x), up))
        return T


def color_voxels(
    points: NDArray[np.float64], colors: NDArray[np.uint8], size: float, least: int
) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Returns the (V, 3) voxels of edge ``size`` from the origin with ``least`` or more of (N, 3) points, and
    their mean colors."""
    index = np.floor(points / size)
    near = (np.abs(index) < _KEY_LIMIT).all(axis=1)
    keys, voxel, count = np.unique(pack_voxels(index[near].astype(np.int64)), return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(voxel, colors[near, channel], len(keys)) for channel in range(3)], axis=1)
    shown = count >= least
    return unpack_voxels(keys[shown]), (total[shown] / count[shown, None]).astype(np.uint8)
