"""Where a frame is at a time: the chain of transforms from the root of tf's tree to a camera. Source: tf2, REP 105."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.transforms import quats_to_rotations, rotations_to_quats
from .camera_messages import transform_matrix

_LONGEST_GAP_S = 0.5
"""Longest time between two transforms over which the motion is interpolated; tf's publishers run at 5 Hz or more."""
_STILL = 1e-6


class FramePaths:
    """Transforms over time. A frame has one parent: the last that was stated."""

    def __init__(self, messages: Iterable[tuple[Any, bool]]):
        """messages: TFMessages, and whether each holds at all times."""
        parents: dict[str, str] = {}
        series: dict[str, list[tuple[float, NDArray[np.float64]]]] = {}
        for message, static in messages:
            for stamped in message.transforms:
                T, stamp = transform_matrix(stamped.transform), stamped.header.stamp
                child, parent = str(stamped.child_frame_id).lstrip("/"), str(stamped.header.frame_id).lstrip("/")
                if T is None:
                    continue
                if static or parents.get(child, parent) != parent:
                    series.pop(child, None)
                parents[child] = parent
                series.setdefault(child, []).append((stamp.sec + stamp.nanosec * 1e-9, T))
        self._parents = parents
        self._series = {child: _Motion(entries) for child, entries in series.items()}

    def pose(self, frame: str, seconds: float) -> NDArray[np.float64] | None:
        """(4, 4) T_root_frame; None if nothing above the frame moves, or the transforms do not reach to the time."""
        T, moves, left = np.eye(4), False, len(self._parents)
        while frame in self._parents and left:
            motion = self._series[frame]
            step = motion.at(seconds)
            if step is None:
                return None
            T, moves = step @ T, moves or motion.moves
            frame, left = self._parents[frame], left - 1
        return T if moves and frame not in self._parents else None


class _Motion:
    """One frame in its parent, over time."""

    def __init__(self, entries: list[tuple[float, NDArray[np.float64]]]):
        self._times, rows = np.unique([seconds for seconds, _ in entries], return_index=True)
        self._T = np.stack([entries[row][1] for row in rows.tolist()])
        self._quats_wxyz = rotations_to_quats(self._T[:, :3, :3])
        self.moves = bool(np.abs(self._T - self._T[0]).max() > _STILL)

    def at(self, seconds: float) -> NDArray[np.float64] | None:
        """(4, 4) T_parent_frame, interpolated; None outside of the known times."""
        if not self.moves:
            return np.asarray(self._T[0])
        after = int(np.searchsorted(self._times, seconds))
        if after < len(self._times) and self._times[after] == seconds:
            return np.asarray(self._T[after])
        if not 0 < after < len(self._times):
            return None
        before, span = after - 1, self._times[after] - self._times[after - 1]
        if span > _LONGEST_GAP_S:
            return None
        share = (seconds - self._times[before]) / span
        a, b = self._quats_wxyz[before], self._quats_wxyz[after]
        quat_wxyz = (1 - share) * a + share * (b if a @ b >= 0 else -b)
        T = np.eye(4)
        T[:3, :3] = quats_to_rotations(quat_wxyz / np.linalg.norm(quat_wxyz))
        T[:3, 3] = (1 - share) * self._T[before, :3, 3] + share * self._T[after, :3, 3]
        return T
