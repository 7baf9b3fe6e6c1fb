"""Runs Open3D's hybrid odometry against keyframes, and a pose graph over them; a baseline for "rgbd"."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...capture.base import Capture
from ...core.errors import ConfigError
from ...core.transforms import invert, nearest_rigid
from ...core.types import Frame, Intrinsics
from ...settings.option_types import Advanced, Device, Finite, Meters, PositiveShare
from .. import pose_graph
from ..base import LEAST_COVERED, KeyframeOptions, Tracked, Tracker
from ..overlap import DepthView, measure_mutual_overlap, sample_points
from ..pose_graph import Edge
from ..records import Records

REQUIRES: tuple[str, ...] = ("open3d",)

_DEPTH_SCALE, _FARTHEST_M = 1.0, 1000.0
"""Units of the depth images per meter, and Open3D's largest depth: beyond all depths, which the reader limits."""

_HUBER_DEPTH, _HUBER_INTENSITY = 0.05, 0.1
"""Residuals, meters and intensities 0…1, above which Huber's loss is linear: Open3D's defaults."""
Iterations = Annotated[int, Meta(ge=0, le=1000)]


class Options(KeyframeOptions, frozen=True):
    """Odometry and keyframes."""

    device: Device = "cpu"
    """Device of the odometry: "cpu", or "cuda:0" and so on if Open3D has CUDA."""
    width: Annotated[int, Meta(ge=16, le=4096)] = 320
    """Image width for tracking, pixels; smaller images keep their size."""
    iterations: Advanced[tuple[Iterations, Iterations, Iterations]] = (10, 6, 4)
    """Gauss–Newton iterations per pyramid level, coarse to fine."""
    depth_difference: Advanced[Meters] = 0.07
    """Largest depth difference of a correspondence, meters."""
    min_fitness: Advanced[PositiveShare] = 0.3
    """Smallest share of pixels with a correspondence."""
    max_residual: Advanced[Annotated[float, Meta(gt=0, le=1000)]] = 0.03
    """Largest root mean square of the odometry's residual, which mixes meters and gray levels 0…1."""
    min_information: Advanced[Finite] = 1e-3
    """Smallest eigenvalue of the information matrix, per correspondence, of a constrained pose."""
    overlap_edges: Advanced[Annotated[int, Meta(ge=0, le=1000)]] = 6
    """Number of earlier keyframes to register a new keyframe to, besides the last: those with most overlap."""
    min_edge_overlap: Advanced[Finite] = 0.4
    """Smallest share of the view that such a keyframe has in common."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if max(self.iterations) == 0:
            raise ConfigError(f"'iterations' must not all be 0, got {list(self.iterations)}.")


@dataclass(frozen=True)
class _View(DepthView):
    """A frame, prepared for the odometry at tracking size."""

    rgbd: object


@dataclass(frozen=True)
class _Match:
    T_target_source: NDArray[np.float64]
    information: NDArray[np.float64]
    fitness: float
    ok: bool


def load(options: Options, capture: Capture) -> OdometryTracker:
    """Load the tracker; it does not read ``capture``. Raises ConfigError for a missing device."""
    return OdometryTracker(options)


class OdometryTracker(Tracker):
    """Registers each frame to the current keyframe, starting from constant velocity. A frame that shares too little
    with it becomes the next keyframe, and is registered to earlier keyframes that see the same place.

    Odometry: J. Park, Q.-Y. Zhou, V. Koltun, Colored Point Cloud Registration Revisited, ICCV 2017, in Open3D's tensor
    implementation (hybrid photometric and geometric residual, multi-scale).
    """

    needs_depth: ClassVar[bool] = True

    def __init__(self, options: Options):
        super().__init__()
        self.options = options
        self.device = _device(options.device)
        self._keyframes: list[_View] = []
        self._T_keyframe_last: NDArray[np.float64] | None = None  # last tracked frame, in the current keyframe
        self._velocity = np.eye(4)  # T_previous_last
        self._frames_lost = 0

    def track(self, frame: Frame) -> Tracked:
        view = self._view(frame)
        if not self._keyframes:
            return self._start(frame.index, view)
        match = self._register_to_keyframe(view)
        if match is None:
            self._frames_lost += 1
            self.records.add_lost(frame.index)
            return Tracked("lost", None, 0.0)
        self._update_velocity(match.T_target_source)
        T_world_cam = self.records.T_world_keyframe[-1] @ match.T_target_source
        confidence = self._confidence(match)
        if self._is_keyframe(view, match):
            self._add_keyframe(frame.index, view, match, confidence)
            return Tracked("keyframe", T_world_cam, confidence)
        self.records.add_tracked(frame.index, len(self._keyframes) - 1, match.T_target_source, confidence)
        return Tracked("tracked", T_world_cam, confidence)

    def optimize(self) -> None:
        self.records.T_world_keyframe = pose_graph.optimize(self.records.T_world_keyframe, self.edges)

    def _start(self, index: int, view: _View) -> Tracked:
        if np.count_nonzero(view.depth_m) < LEAST_COVERED * view.depth_m.size:
            self.records.add_lost(index)
            return Tracked("lost", None, 0.0)
        self.records.add_keyframe(index, np.eye(4), 1.0)
        self._keyframes.append(view)
        self._T_keyframe_last = np.eye(4)
        return Tracked("keyframe", np.eye(4), 1.0)

    def _register_to_keyframe(self, view: _View) -> _Match | None:
        """The match with the current keyframe, from the first initial guess that passes the failure test."""
        assert self._T_keyframe_last is not None
        guesses = [self._T_keyframe_last @ self._velocity, self._T_keyframe_last]
        for guess in guesses:
            match = self._register(view, self._keyframes[-1], guess)
            if match.ok:
                return match
        return None

    def _register(self, source: _View, target: _View, T_target_source: NDArray[np.float64]) -> _Match:
        """Run the odometry of ``source`` against ``target``, with a failure test."""
        import open3d as o3d

        odometry = o3d.t.pipelines.odometry
        failed = _Match(T_target_source, np.eye(6), 0.0, ok=False)
        valid = np.count_nonzero(source.depth_m) / source.depth_m.size
        if valid < LEAST_COVERED:
            return failed
        K = o3d.core.Tensor(source.intrinsics.matrix)
        try:
            result = odometry.rgbd_odometry_multi_scale(
                source.rgbd, target.rgbd, K, o3d.core.Tensor(T_target_source), _DEPTH_SCALE, _FARTHEST_M,
                [odometry.OdometryConvergenceCriteria(n) for n in self.options.iterations],
                odometry.Method.Hybrid,
                odometry.OdometryLossParams(self.options.depth_difference, _HUBER_DEPTH, _HUBER_INTENSITY),
            )  # fmt: skip
        except RuntimeError:  # a singular system: there is nothing to align
            return failed
        T = result.transformation.cpu().numpy()
        fitness, residual = result.fitness / valid, result.inlier_rmse
        if not np.isfinite(T).all() or fitness < self.options.min_fitness or residual > self.options.max_residual:
            return failed
        information = odometry.compute_odometry_information_matrix(
            source.rgbd.depth, target.rgbd.depth, K, result.transformation,  # type: ignore[attr-defined]
            self.options.depth_difference, _DEPTH_SCALE, _FARTHEST_M,
        ).cpu().numpy()  # fmt: skip
        weakest = np.linalg.eigvalsh(information)[0] / max(information[5, 5], 1.0)
        return _Match(nearest_rigid(T), information, fitness, ok=bool(weakest >= self.options.min_information))

    def _update_velocity(self, T_keyframe_cam: NDArray[np.float64]) -> None:
        assert self._T_keyframe_last is not None
        moved = invert(self._T_keyframe_last) @ T_keyframe_cam
        self._velocity = moved if self._frames_lost == 0 else np.eye(4)
        self._T_keyframe_last = T_keyframe_cam
        self._frames_lost = 0

    def _is_keyframe(self, view: _View, match: _Match) -> bool:
        return measure_mutual_overlap(view, self._keyframes[-1], match.T_target_source) < self.options.keyframe_overlap

    def _confidence(self, match: _Match) -> float:
        return float(np.clip(match.fitness, 0.0, 1.0))

    def _add_keyframe(self, index: int, view: _View, match: _Match, confidence: float) -> None:
        row = len(self._keyframes)
        self.records.add_keyframe(index, self.records.T_world_keyframe[-1] @ match.T_target_source, confidence)
        self.edges.append(Edge(row, row - 1, match.T_target_source, match.information, uncertain=False))
        self._keyframes.append(view)
        self._T_keyframe_last = np.eye(4)
        self._add_overlap_edges(row)

    def _add_overlap_edges(self, row: int) -> None:
        """Register keyframe ``row`` to the earlier keyframes that share most of its view at the current poses."""
        view, T_cam_world = self._keyframes[row], invert(self.records.T_world_keyframe[row])
        shared = [
            measure_mutual_overlap(other, view, T_cam_world @ self.records.T_world_keyframe[k])
            for k, other in enumerate(self._keyframes[: row - 1])
        ]
        best = np.argsort(shared)[::-1][: self.options.overlap_edges]
        for k in (int(k) for k in best if shared[k] >= self.options.min_edge_overlap):
            guess = invert(self.records.T_world_keyframe[k]) @ self.records.T_world_keyframe[row]
            match = self._register(view, self._keyframes[k], guess)
            if match.ok:
                self.edges.append(Edge(row, k, match.T_target_source, match.information, uncertain=True))

    def _view(self, frame: Frame) -> _View:
        import open3d as o3d

        camera, color, depth = frame.intrinsics, frame.color, frame.depth_m
        step = max(1, round(camera.width / self.options.width))
        if step > 1:
            # Depth is picked, never averaged across an edge; color is averaged around the same pixels, by a window of
            # odd size, so that both stay registered and the principal point moves with them exactly.
            first = step // 2
            color = cv2.blur(color, (step | 1, step | 1))[first::step, first::step]
            depth = depth[first::step, first::step]
            camera = Intrinsics(
                depth.shape[1], depth.shape[0], camera.fx / step, camera.fy / step,
                (camera.cx - first) / step, (camera.cy - first) / step,
            )  # fmt: skip
        depth = np.ascontiguousarray(depth)
        rgbd = o3d.t.geometry.RGBDImage(
            o3d.t.geometry.Image(np.ascontiguousarray(color)), o3d.t.geometry.Image(depth[..., None])
        ).to(self.device)
        return _View(depth, camera, sample_points(depth, camera), rgbd)

    def state(self) -> dict[str, NDArray[np.generic]]:
        last = self._T_keyframe_last if self._T_keyframe_last is not None else np.eye(4)
        return {
            **super().state(),
            "last": np.stack((last, self._velocity)),
            "frames_lost": np.array(self._frames_lost),
        }

    def restore(self, state: dict[str, NDArray[np.generic]], read: Callable[[int], Frame]) -> None:
        self.records = Records.from_arrays(state)
        self._keyframes = [self._view(read(index)) for index in self.records.keyframe_index]
        self._T_keyframe_last, self._velocity = np.asarray(state["last"], np.float64)
        self._frames_lost = int(state["frames_lost"])
        self.edges = pose_graph.edges_from_arrays(state)


def _device(name: str) -> object:
    """The Open3D device with a name such as "cpu" or "cuda:0". Raises ConfigError if it does not exist."""
    import open3d as o3d

    kind, _, number = name.lower().partition(":")
    number = number or "0"
    if kind not in ("cpu", "cuda") or not number.isdigit():
        raise ConfigError(f"Unknown device '{name}': use cpu or cuda:0.")
    if kind == "cuda" and int(number) >= o3d.core.cuda.device_count():
        raise ConfigError(f"There is no device '{name}': Open3D sees {o3d.core.cuda.device_count()} CUDA devices here.")
    return o3d.core.Device(kind.upper(), int(number))
