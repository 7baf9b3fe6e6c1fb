"""The log of every tracker: each frame's pose relative to its keyframe, and the keyframes' poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from ..core.types import Submap, Trajectory
from .pose_graph import Edge, agrees_with_edge

STATUSES = ("unused", "lost", "tracked", "keyframe", "relocalised", "interpolated", "apart")

_LONGEST_GAP = 3
"""Longest run of lost frames that is a gap. Poses in a gap are interpolated between the poses around it."""


@dataclass
class Records:
    """Per frame: index in the capture, row of its keyframe (-1 = lost), T_keyframe_cam, status and confidence. Poses
    are relative to keyframes, so a frame moves with its keyframe when the pose graph moves it.

    submap: number of each keyframe's submap, a part of the camera path without a tracking break.  pieces: keyframe rows
    of each connected component, the largest first; only the largest has poses in the world. Empty = each submap is its
    own component."""

    index: list[int] = field(default_factory=list)
    keyframe: list[int] = field(default_factory=list)
    T_keyframe_cam: list[NDArray[np.float64]] = field(default_factory=list)
    status: list[int] = field(default_factory=list)
    confidence: list[float] = field(default_factory=list)
    keyframe_index: list[int] = field(default_factory=list)
    T_world_keyframe: list[NDArray[np.float64]] = field(default_factory=list)
    submap: list[int] = field(default_factory=list)
    pieces: list[list[int]] = field(default_factory=list)

    def add_keyframe(self, index: int, T_world_cam: NDArray[np.float64], confidence: float, submap: int = 0) -> None:
        """Add a frame that becomes the next keyframe."""
        self.submap.append(submap)
        self.pieces = []
        self.keyframe_index.append(index)
        self.T_world_keyframe.append(T_world_cam)
        self._add(index, len(self.keyframe_index) - 1, np.eye(4), "keyframe", confidence)

    def add_tracked(
        self, index: int, keyframe: int, T_keyframe_cam: NDArray[np.float64], confidence: float, status: str = "tracked"
    ) -> None:
        """Add a frame with a pose relative to a keyframe."""
        self._add(index, keyframe, T_keyframe_cam, status, confidence)

    def add_lost(self, index: int) -> None:
        """Add a frame without a pose."""
        self._add(index, -1, np.full((4, 4), np.nan), "lost", 0.0)

    def _add(self, index: int, keyframe: int, T: NDArray[np.float64], status: str, confidence: float) -> None:
        self.index.append(index)
        self.keyframe.append(keyframe)
        self.T_keyframe_cam.append(T)
        self.status.append(STATUSES.index(status))
        self.confidence.append(confidence)

    def largest_first(self) -> list[list[int]]:
        """Keyframe rows of each connected component, the largest first."""
        if self.pieces:
            return self.pieces
        rows: dict[int, list[int]] = {}
        for row, name in enumerate(self.submap):
            rows.setdefault(name, []).append(row)
        return sorted(rows.values(), key=lambda piece: (-len(piece), piece[0]))

    def _worth_telling(self) -> list[list[int]]:
        """``largest_first`` without small components, which are gaps: a blurred frame, or a hand in front of the
        camera. The first component always stays."""
        frames = np.bincount(np.array([k for k in self.keyframe if k >= 0], np.int64), minlength=len(self.submap))
        first, *others = self.largest_first() or [[]]
        return [first, *(piece for piece in others if frames[piece].sum() > _LONGEST_GAP)]

    def trajectory(self, timestamps: NDArray[np.float64]) -> Trajectory:
        """Poses of all frames of the capture, from the keyframes' current poses. Frames of other components than the
        largest have no pose: they are "apart", or "lost" if the component is small."""
        n = len(timestamps)
        T_world_cam = np.full((n, 4, 4), np.nan)
        status = np.full(n, "unused", dtype="<U12")
        confidence = np.zeros(n, np.float32)
        pieces = self._worth_telling()
        mapped = np.array(sorted(pieces[0]), np.int64)
        if self.index:
            rows, keyframe = np.array(self.index), np.array(self.keyframe)
            status[rows] = np.array(STATUSES)[self.status]
            confidence[rows] = self.confidence
            posed = np.isin(keyframe, mapped)
            status[rows[~posed]] = "lost"
            status[rows[np.isin(keyframe, [k for piece in pieces[1:] for k in piece])]] = "apart"
            confidence[rows[~posed]] = 0.0
            if posed.any():
                T_world_keyframe = np.stack(self.T_world_keyframe)[keyframe[posed]]
                T_world_cam[rows[posed]] = T_world_keyframe @ np.stack(self.T_keyframe_cam)[posed]
                _fill_gaps(T_world_cam, status, confidence, rows)
        keyframes = np.array(self.keyframe_index, np.int32)[mapped]
        return Trajectory(timestamps, T_world_cam, keyframes, status, confidence)

    def submaps(self, edges: Sequence[Edge] = ()) -> list[Submap]:
        """The connected components of the camera path, the mapped one first, each in the frame of its keyframes.

        edges: measurements between keyframes; the uncertain ones are loop closures.
        """
        if not self.keyframe_index:
            return []
        order = np.argsort(self.index, kind="stable")
        index, keyframe = np.array(self.index, np.int32)[order], np.array(self.keyframe)[order]
        T_keyframe_cam = np.stack(self.T_keyframe_cam)[order]
        found = []
        for rows in self._worth_telling():
            inside = np.isin(keyframe, rows)
            T_submap_keyframe = np.stack(self.T_world_keyframe)[keyframe[inside]]
            closed = [e for e in edges if e.uncertain and e.source in rows and e.target in rows]
            named = np.array(self.keyframe_index, np.int32)
            found.append(
                Submap(
                    index[inside],
                    T_submap_keyframe @ T_keyframe_cam[inside],
                    named[sorted(rows)],
                    named[[(e.source, e.target) for e in closed]] if closed else np.zeros((0, 2), np.int32),
                    np.array([agrees_with_edge(self.T_world_keyframe, e) for e in closed], bool),
                )
            )
        return found

    def to_arrays(self) -> dict[str, NDArray[np.generic]]:
        """The records as plain arrays, for saving."""
        return {
            "index": np.array(self.index, np.int64),
            "keyframe": np.array(self.keyframe, np.int64),
            "T_keyframe_cam": np.array(self.T_keyframe_cam, np.float64).reshape(-1, 4, 4),
            "status": np.array(self.status, np.int64),
            "confidence": np.array(self.confidence, np.float64),
            "keyframe_index": np.array(self.keyframe_index, np.int64),
            "T_world_keyframe": np.array(self.T_world_keyframe, np.float64).reshape(-1, 4, 4),
            "submap": np.array(self.submap, np.int64),
            "pieces": np.array([row for piece in self.pieces for row in piece], np.int64),
            "piece_lengths": np.array([len(piece) for piece in self.pieces], np.int64),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> Records:
        """The inverse of ``to_arrays``."""
        ends = np.cumsum(arrays["piece_lengths"])[:-1]
        return cls(
            index=arrays["index"].tolist(),
            keyframe=arrays["keyframe"].tolist(),
            T_keyframe_cam=list(np.asarray(arrays["T_keyframe_cam"], np.float64)),
            status=arrays["status"].tolist(),
            confidence=arrays["confidence"].tolist(),
            keyframe_index=arrays["keyframe_index"].tolist(),
            T_world_keyframe=list(np.asarray(arrays["T_world_keyframe"], np.float64)),
            submap=arrays["submap"].tolist(),
            pieces=[piece.tolist() for piece in np.split(arrays["pieces"], ends) if len(piece)],
        )


def _fill_gaps(
    T_world_cam: NDArray[np.float64],
    status: NDArray[np.str_],
    confidence: NDArray[np.float32],
    rows: NDArray[np.int64],
) -> None:
    """Fill short runs of lost frames in place, with poses on the geodesic between the poses before and after."""
    known = np.flatnonzero(np.isfinite(T_world_cam[rows, 0, 0]))
    for before, after in pairwise(known.tolist()):
        between = after - before - 1
        if not 0 < between <= _LONGEST_GAP or (status[rows[before + 1 : after]] != "lost").any():
            continue
        share = np.arange(1, between + 1) / (between + 1)
        ends = T_world_cam[rows[[before, after]]]
        inside = rows[before + 1 : after]
        turns = Slerp([0, 1], Rotation.from_matrix(ends[:, :3, :3]))(share)
        T_world_cam[inside] = np.eye(4)
        T_world_cam[inside, :3, :3] = turns.as_matrix()
        T_world_cam[inside, :3, 3] = (1 - share[:, None]) * ends[0, :3, 3] + share[:, None] * ends[1, :3, 3]
        status[inside] = "interpolated"
        confidence[inside] = 0.5 * min(confidence[rows[before]], confidence[rows[after]])
