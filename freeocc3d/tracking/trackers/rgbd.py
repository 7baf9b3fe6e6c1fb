"""Estimates poses from color and depth: dense tracking, relocalization, loop closures, a joint refinement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...capture.base import Capture
from ...core.transforms import invert, measure_pose_difference
from ...core.types import Frame
from ...settings.option_types import Advanced
from .. import pose_graph
from ..base import LEAST_COVERED, KeyframeOptions, Overlap, Tracked, Tracker
from ..overlap import DepthView, measure_mutual_overlap
from ..pose_graph import Edge
from ..records import Records
from ..rgbd import dense_alignment, joint_refinement, loop_closures
from ..rgbd.alignment_views import AlignmentView, prepare_alignment_view
from ..rgbd.keyframe_registration import (
    FeatureRegistration,
    KeyframeView,
    prepare_keyframe_view,
    register_by_features,
    sample_surface,
)

REQUIRES: tuple[str, ...] = ("open3d",)

_LEAST_OVERLAP, _LEAST_INLIERS, _LEAST_CORRELATION = 0.3, 0.6, 0.5  # the smallest; below them the frame is lost
_CONFIRMED_OVERLAP, _CONFIRMED_M, _CONFIRMED_DEG = 0.15, 0.15, 8.0  # features and surfaces agree
_RECOGNIZED_OVERLAP = 0.5  # smallest overlap at which a sure alignment alone recovers a lost frame
_SURE_INLIERS, _SURE_CORRELATION = 0.75, 0.96  # below them features are matched too
_LIKELY_CORRELATION = 0.8  # smallest correlation of a likely pose
_JUMP_M, _JUMP_DEG = 0.10, 6.0  # from the predicted pose; beyond it features are matched too
_FEATURES = 20  # smallest number of features that agree on one pose
_DRAWS = 1000  # of RANSAC for a lost frame, which deserves more draws
_RECENT = 4  # last keyframes to compare a lost frame with, besides similar ones
_OLDER = 40  # approximate number of older keyframes, spread over the path, among which to look for similar ones
_LEAST_SCORED = 0.1  # smallest correlation in a pose's score: uniform surfaces have none


class Options(KeyframeOptions, frozen=True):
    """Tracking, loop closure and refinement."""

    keyframe_overlap: Overlap = 0.8
    close_loops: Advanced[bool] = True
    """Find loop closures, and make the camera path agree with them."""
    refine: Advanced[bool] = True
    """Align all overlapping keyframes jointly at the end."""
    neighbors: Advanced[Annotated[int, Meta(ge=1, le=1000)]] = 16
    """Number of earlier keyframes to align each keyframe with in the refinement."""


def load(options: Options, capture: Capture) -> RgbdTracker:
    """Load the tracker; it does not read ``capture``."""
    return RgbdTracker(options)


@dataclass(frozen=True)
class _Seen:
    """A prepared frame; its features are detected on first use."""

    frame: Frame
    view: AlignmentView
    surface: DepthView
    _full: list[KeyframeView] = field(default_factory=list)

    @property
    def full(self) -> KeyframeView:
        if not self._full:
            self._full.append(prepare_keyframe_view(self.frame, self.view))
        return self._full[0]


class RgbdTracker(Tracker):
    """Aligns each frame densely to a keyframe, starting from constant velocity. If the result is doubtful, it starts
    from the pose that matched features give. A frame that shares too little with its keyframe becomes the next
    keyframe. A lost frame is relocalized against the keyframes so far; if no keyframe shows the same place, it begins a
    new submap.

    ``optimize`` closes loops, connects submaps that show the same place, and aligns all keyframes jointly. The largest
    connected component is mapped.
    """

    needs_depth: ClassVar[bool] = True

    def __init__(self, options: Options):
        super().__init__()
        self.options = options
        self.keyframes: list[KeyframeView] = []
        self._current = -1  # row of the keyframe that frames are aligned to
        self._T_keyframe_last = np.eye(4)  # last tracked frame, in that keyframe
        self._velocity = np.eye(4)  # T_previous_last
        self._frames_lost = 0
        self._last: _Seen | None = None  # the last frame with a pose, unless it began a submap

    def track(self, frame: Frame) -> Tracked:
        seen = _see(frame)
        if seen.view.covered < LEAST_COVERED:
            return self._lose(frame.index)
        if not self.keyframes:
            return self._begin_submap(seen)
        aligned = self._follow(seen)
        if aligned is None:
            return self._relocalize(seen) or self._begin_submap(seen)
        T = aligned.T_target_source
        self._velocity = invert(self._T_keyframe_last) @ T if self._frames_lost == 0 else np.eye(4)
        return self._place(seen, aligned, "tracked")

    def optimize(self) -> None:
        T = self.records.T_world_keyframe
        self.edges = [edge for edge in self.edges if not edge.uncertain]
        if self.options.close_loops and len(T) > 2:
            found = loop_closures.find_closures(self.keyframes, self.records.submap, T)
            self.edges = pose_graph.drop_unsupported_closures(T, self.records.submap, [*self.edges, *found])
        pieces = pose_graph.find_connected_components(self.records.submap, self.edges)
        for rows in pieces:
            placed = pose_graph.optimize_component(T, self.edges, rows)
            if self.options.refine:
                placed = joint_refinement.refine_poses(
                    [self.keyframes[k] for k in rows], placed, self.options.neighbors
                )
            for k, pose in zip(rows, placed, strict=True):
                T[k] = pose
        self.records.pieces = pieces

    def release(self) -> None:
        self.keyframes, self._last = [], None  # 0.7 MB each

    def _follow(self, seen: _Seen) -> dense_alignment.ViewAlignment | None:
        """The alignment to the current keyframe; None if it is not reliable."""
        target = self.keyframes[self._current]
        guess = self._T_keyframe_last @ self._velocity
        aligned = dense_alignment.align_views(seen.view, target.view, guess)
        meters, degrees = measure_pose_difference(guess, aligned.T_target_source)
        if _sure(aligned) and meters <= _JUMP_M and degrees <= _JUMP_DEG and self._frames_lost == 0:
            return aligned
        found = register_by_features(seen.full, target)
        if found is not None and _confirmed(found) and _score(found.aligned) >= _score(aligned):
            return found.aligned
        steady = meters <= _JUMP_M and degrees <= _JUMP_DEG and self._frames_lost == 0
        alike = not aligned.correlation < _LIKELY_CORRELATION  # NaN: flat intensities cannot disagree
        good = alike and aligned.overlap >= _LEAST_OVERLAP and aligned.inliers >= _SURE_INLIERS
        return aligned if good and (steady or aligned.correlation >= _SURE_CORRELATION) else None

    def _relocalize(self, seen: _Seen) -> Tracked | None:
        """Relocalize a frame that does not align with the current keyframe: by the last frame, or by other
        keyframes."""
        self._velocity = np.eye(4)
        if self._last is not None:
            found = register_by_features(seen.full, self._last.full, _DRAWS)
            if found is not None and _recognized(found):
                T = self._T_keyframe_last @ found.aligned.T_target_source
                return self._place(seen, replace(found.aligned, T_target_source=T), "relocalised")
        best: tuple[dense_alignment.ViewAlignment, int] | None = None
        for row in self._alike(seen):
            found = register_by_features(seen.full, self.keyframes[row], _DRAWS)
            if found is None or not _recognized(found):
                continue
            if best is None or _score(found.aligned) > _score(best[0]):
                best = found.aligned, row
        if best is None:
            return None
        self._current = best[1]
        return self._place(seen, best[0], "relocalised")

    def _alike(self, seen: _Seen) -> list[int]:
        """Keyframes that a lost frame may show: the last ones, and those with most common features."""
        described = seen.full.features
        last = len(self.keyframes) - 1
        recent = [row for row in range(last, max(-1, last - _RECENT), -1) if row != self._current]
        if not len(described.pixels):
            return recent
        older = [row for row in range(last + 1) if row not in recent and row != self._current]
        step = max(1, len(older) // _OLDER)
        scored = [
            (loop_closures.count_common_features(described, self.keyframes[row].features), row) for row in older[::step]
        ]
        return recent + [row for _, row in sorted(scored, reverse=True)[: loop_closures.CANDIDATES]]

    def _place(self, seen: _Seen, aligned: dense_alignment.ViewAlignment, status: str) -> Tracked:
        """Add the frame to the current keyframe, or make it the next keyframe."""
        self._frames_lost = 0
        self._last = seen
        self._T_keyframe_last = aligned.T_target_source
        T_world_cam = self.records.T_world_keyframe[self._current] @ aligned.T_target_source
        confidence = _confidence(aligned)
        index, target = seen.frame.index, self.keyframes[self._current]
        shared = measure_mutual_overlap(seen.surface, target.overlap, aligned.T_target_source)
        if shared >= self.options.keyframe_overlap:
            self.records.add_tracked(index, self._current, aligned.T_target_source, confidence, status)
            return Tracked(status, T_world_cam, confidence)
        row = len(self.keyframes)
        self.edges.append(Edge(row, self._current, aligned.T_target_source, aligned.information, uncertain=False))
        self._add_keyframe(seen, T_world_cam, confidence, self.records.submap[self._current])
        return Tracked("keyframe", T_world_cam, confidence)

    def _begin_submap(self, seen: _Seen) -> Tracked:
        self._velocity, self._frames_lost, self._last = np.eye(4), 0, None
        self._add_keyframe(seen, np.eye(4), 1.0, max(self.records.submap, default=-1) + 1)
        return Tracked("keyframe", np.eye(4), 1.0)

    def _add_keyframe(self, seen: _Seen, T_world_cam: NDArray[np.float64], confidence: float, submap: int) -> None:
        self.records.add_keyframe(seen.frame.index, T_world_cam, confidence, submap)
        self.keyframes.append(seen.full)
        self._current = len(self.keyframes) - 1
        self._T_keyframe_last = np.eye(4)

    def _lose(self, index: int) -> Tracked:
        self._frames_lost += 1
        self.records.add_lost(index)
        return Tracked("lost", None, 0.0)

    def state(self) -> dict[str, NDArray[np.generic]]:
        return {
            **super().state(),
            "last": np.stack((self._T_keyframe_last, self._velocity)),
            "counters": np.array((self._current, self._frames_lost)),
            "last_frame": np.array([] if self._last is None else [self._last.frame.index], np.int64),
        }

    def restore(self, state: dict[str, NDArray[np.generic]], read: Callable[[int], Frame]) -> None:
        self.records = Records.from_arrays(state)
        self.keyframes = [prepare_keyframe_view(read(index)) for index in self.records.keyframe_index]
        self._T_keyframe_last, self._velocity = np.asarray(state["last"], np.float64)
        self._current, self._frames_lost = state["counters"].tolist()
        self._last = next((_see(read(index)) for index in state["last_frame"].tolist()), None)
        self.edges = pose_graph.edges_from_arrays(state)


def _see(frame: Frame) -> _Seen:
    view = prepare_alignment_view(frame)
    return _Seen(frame, view, sample_surface(view))


def _confirmed(found: FeatureRegistration) -> bool:
    """Whether enough features agree, dense alignment stays near their pose, and surfaces and intensities agree."""
    aligned = found.aligned
    meters, degrees = measure_pose_difference(found.by_features, aligned.T_target_source)
    alike = not aligned.correlation < _LEAST_CORRELATION  # NaN: flat intensities cannot disagree
    seen = aligned.overlap >= _CONFIRMED_OVERLAP and aligned.inliers >= _LEAST_INLIERS
    return found.agreeing >= _FEATURES and alike and seen and meters <= _CONFIRMED_M and degrees <= _CONFIRMED_DEG


def _recognized(found: FeatureRegistration) -> bool:
    """Whether a lost frame is relocalized reliably: by features and surfaces that agree, or, if the feature pose is
    rough, by surfaces that overlap much and look the same."""
    seen_again = _sure(found.aligned) and found.aligned.overlap >= _RECOGNIZED_OVERLAP
    return seen_again or (_confirmed(found) and _likely(found.aligned))


def _sure(aligned: dense_alignment.ViewAlignment) -> bool:
    return _likely(aligned) and aligned.overlap >= _LEAST_OVERLAP and aligned.correlation >= _SURE_CORRELATION


def _likely(aligned: dense_alignment.ViewAlignment) -> bool:
    return aligned.determined and aligned.inliers >= _SURE_INLIERS and aligned.correlation >= _LIKELY_CORRELATION


def _score(aligned: dense_alignment.ViewAlignment) -> float:
    return aligned.inliers * max(np.nan_to_num(aligned.correlation), _LEAST_SCORED)


def _confidence(aligned: dense_alignment.ViewAlignment) -> float:
    alike = 0.5 if np.isnan(aligned.correlation) else max(aligned.correlation, 0.0)
    return float(np.clip(aligned.inliers * alike * (1.0 if aligned.determined else 0.5), 0.0, 1.0))
