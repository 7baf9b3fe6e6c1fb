"""The online mapper: takes frames one by one, and builds layers 2-4 of what it has seen so far."""

from __future__ import annotations

import contextlib
import itertools
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from ..capture import base as capture_base
from ..core.depth_sensors import find_sensor
from ..core.errors import FrameError, TrackingError
from ..core.progress import Progress
from ..core.types import Frame, Gaussians, Occupancy, PosedFrame, Submap, Trajectory
from ..depth.base import DepthSource, MeasuredDepth
from ..depth.stereo_source import StereoSource
from ..editing import adaptive_voxels
from ..gaussians import anchors, fitting, rendered_views
from ..gaussians.rasterizers.base import Rasterizer
from ..language import lifting
from ..language.encoders.base import Encoder
from ..occupancy import build
from ..occupancy.confirmed_depth import hide_unconfirmed
from ..settings.config import Settings
from ..storage import map_files
from ..storage.keyframes import Keyframes
from ..tracking.base import Tracked, Tracker
from ..tracking.upright.lattice import find_lattice_origin
from ..tracking.upright.surface_patches import SurfacePatches, find_surface_patches
from ..tracking.upright.up_direction import turn_back
from ..tracking.upright.upright_frame import UprightFrame, find_upright_frame
from .frame_cache import FrameCache
from .sensor_choice import choose_sensor
from .tracking_choice import choose_tracker

_FINE = 0.01
"""Edge of cells over the usual depth, if the scale is unknown: about the finest detail that stereo resolves."""

_AHEAD = 4  # keyframes that wait to be written

_FITTED_PER_FRAME, _FITTED_PER_KEYFRAME = 0.45, 1.25
"""Small renderings that fitting may take for each frame and each keyframe. The rest of a run takes 30 ms of a processor
for a frame and about 100 ms for a keyframe, a small rendering 25 to 50 ms: fitting stays below a third of the run."""


class Mapper:
    """Takes frames one by one. ``folder`` receives the keyframes. Memory grows with the number of keyframes only.

    Poses and layers 2-4 are in the map's frame: the tracker's world until ``refine`` finds the upright frame."""

    def __init__(self, settings: Settings, capture: Capture, folder: Path):
        settings, _ = choose_tracker(settings, capture)
        settings, _ = choose_sensor(settings, capture)
        self.settings = settings
        self.capture = capture
        self.sensor = find_sensor(settings.capture.sensor)
        self._keyframes = Keyframes(folder / map_files.KEYFRAMES, self.sensor)
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="keyframes")
        self._writing: deque[Future[None]] = deque()
        self.tracker: Tracker = settings.load_backend("tracking", capture)
        if self.tracker.needs_depth and not capture.has_depth:
            raise TrackingError(
                f"tracking.backend={settings.tracking.backend} needs depth, but {capture.path} has none, or "
                "capture.depth=false: leave tracking.backend at auto, or give poses (known, file)."
            )
        self.depth: DepthSource = MeasuredDepth()
        if not (capture.has_depth or self.tracker.brings_depth):
            self.depth = StereoSource(capture, settings.stereo)
        self.rasterizer: Rasterizer = settings.load_backend("fitting")
        self.refined = False
        """Whether all poses so far are consistent with each other."""
        self.upright: UprightFrame | None = None
        """The frame of the map, found by the last ``refine``. None = the tracker's world."""
        self.cache = FrameCache(
            folder, self._read, lambda frame: anchors.choose_stride(frame, settings.gaussians, self.cell_size)
        )
        self.origin = np.zeros(3)
        """(3,) lower corner of voxel (0, 0, 0) in the map's frame, meters."""

    @property
    def offline(self) -> bool:
        """Whether ``prepare`` works through the whole scan before the first frame is added."""
        return self.tracker.offline or self.depth.offline

    def prepare(self, folder: Path, frames: range, progress: Progress) -> None:
        """Run the work of the tracker and then of the depth source on the whole scan, before its first frame; called if
        ``offline``. folder: receives what an interrupted run needs to resume.  frames: the used frames."""
        if self.tracker.offline:
            self.tracker.prepare(folder, frames, progress)
        if self.depth.offline:
            self.depth.prepare(self.tracker, folder, frames, progress)

    @property
    def keyframes(self) -> Keyframes:
        """All keyframes, when their images are written. Raises OSError."""
        while self._writing:
            self._writing.popleft().result()
        return self._keyframes

    def settle(self) -> None:
        """Wait until no image is being written; for the end of a run that fails, when the folder may be removed."""
        wait(self._writing)

    def add(self, frame: Frame) -> Tracked:
        """Track the next frame, and keep it if it is a keyframe; images are written on other threads. Raises OSError,
        which may be of an earlier frame."""
        frame = self.complete(frame)
        tracked = self.tracker.track(frame)
        self.refined = False
        if tracked.T_world_cam is not None:
            self.cache.keep(frame)
        if tracked.status == "keyframe":
            while len(self._writing) >= _AHEAD:
                self._writing.popleft().result()
            self._writing.append(self._writer.submit(self._keep, frame))
        if tracked.T_world_cam is None:
            return tracked
        return replace(tracked, T_world_cam=self.T_map_world @ tracked.T_world_cam)

    def _keep(self, frame: Frame) -> None:
        self._keyframes.append(frame)
        self._keyframes.sync()

    def refine(self) -> None:
        """Make all poses so far consistent with each other, and let the map stand upright: z up, the floor at z = 0."""
        self.tracker.optimize()
        trajectory = self.tracker.trajectory(self.capture.timestamps)
        turned = np.array([self.capture.turned(index) for index in trajectory.keyframes.tolist()], np.int8)
        patches = self._patches(trajectory)
        self.upright = find_upright_frame(turn_back(trajectory.T_world_keyframe, turned), patches)
        self.origin = self._find_origin(self.upright, patches)
        self.refined = True

    def _patches(self, trajectory: Trajectory) -> SurfacePatches:
        """What is flat in the mapped keyframes, in the tracker's world."""
        return find_surface_patches(self.mapped(trajectory).depth_images(), trajectory.T_world_keyframe)

    def _find_origin(self, upright: UprightFrame, patches: SurfacePatches) -> NDArray[np.float64]:
        return find_lattice_origin(patches.moved(upright.T_upright_world), self.settings.occupancy.voxel_size)

    @property
    def T_map_world(self) -> NDArray[np.float64]:
        """(4, 4) from the tracker's world to the map's frame."""
        return np.eye(4) if self.upright is None else self.upright.T_upright_world

    def state(self, done: int) -> dict[str, NDArray[Any]]:
        """What ``restore`` needs after ``done`` frames, apart from the keyframes' images, which are on the disk
        then."""
        own = {"done": done, "refined": self.refined, "keyframes": self.keyframes.checkpoint(),
               "origin": self.origin, "voxel_size": self.settings.occupancy.voxel_size}  # fmt: skip
        frame = {} if self.upright is None else {"upright": self.upright.to_array()}
        return {**{name: np.array(value) for name, value in own.items()}, **frame, **self.tracker.state()}

    def restore(self, state: dict[str, NDArray[Any]]) -> int:
        """Continue from a ``state``, to the same map as without a stop. Returns the number of frames that were added.
        Voxels may have another size than before. Reads keyframes from the capture: those on disk are compressed. Raises
        CaptureError if one is unreadable now."""
        done, self.refined = int(state.pop("done")), bool(state.pop("refined"))
        checkpoint, self.origin = str(state.pop("keyframes")), state.pop("origin")
        self.upright = UprightFrame.from_array(state.pop("upright")) if "upright" in state else None
        self._keyframes = Keyframes.resumed(self._keyframes.folder, checkpoint, self._read, self.sensor)
        same_voxels = float(state.pop("voxel_size")) == self.settings.occupancy.voxel_size
        self.tracker.restore(state, self._read)
        if self.upright is not None and not same_voxels:
            patches = self._patches(self.tracker.trajectory(self.capture.timestamps))
            self.origin = self._find_origin(self.upright, patches)
        return done

    def trajectory(self) -> Trajectory:
        """Poses so far, one row per frame of the capture."""
        found = self.tracker.trajectory(self.capture.timestamps)
        return replace(found, T_world_cam=self.T_map_world @ found.T_world_cam)

    def submaps(self) -> list[Submap]:
        """The connected components of the camera path: the mapped one first, in the map's frame; the others in their
        own."""
        found = self.tracker.submaps()
        return [replace(each, T_submap_cam=self.T_map_world @ each.T_submap_cam) for each in found[:1]] + found[1:]

    def mapped(self, trajectory: Trajectory) -> Keyframes:
        """The mapped keyframes: those of the largest submap."""
        return self.keyframes.only(trajectory.keyframes)

    def frames_used(self, trajectory: Trajectory, every: int) -> NDArray[np.int64]:
        """Indices of the mapped keyframes and of every n-th mapped frame that was tracked (0 = none of these)."""
        measured = np.flatnonzero(np.isin(trajectory.status, ("keyframe", "tracked", "relocalised")))
        return np.union1d(trajectory.keyframes, measured[::every] if every else [])

    def posed(self, trajectory: Trajectory, every: int, color: bool = True) -> Iterator[PosedFrame]:
        """Yields the frames of ``frames_used`` with their poses, from the run's cache, and without their colors if
        ``color`` is false; without frames between them, keyframes as they were saved. Leaves out a frame that can no
        longer be decoded."""
        if not every:
            posed = zip(self.mapped(trajectory), trajectory.T_world_keyframe, strict=True)
            yield from (PosedFrame(frame, T, row) for row, (frame, T) in enumerate(posed))
            return
        indices = self.frames_used(trajectory, every).tolist()
        rows = np.maximum(np.searchsorted(trajectory.keyframes, indices, side="right") - 1, 0).tolist()
        with contextlib.closing(self.cache.frames(indices, color)) as frames:
            for index, row, frame in zip(indices, rows, frames, strict=True):
                if not isinstance(frame, FrameError):
                    yield PosedFrame(frame, trajectory.T_world_cam[index], row)

    def anchor_gaussians(self, progress: Progress | None = None) -> Gaussians:
        """Layer 2 before fitting: Gaussians anchored at the surface that the mapped frames so far show."""
        progress = progress or Progress()
        trajectory = self.trajectory()
        options = self.settings.gaussians
        progress.stage("gaussians", 2 * len(self.frames_used(trajectory, options.every)))
        cells = anchors.AnchoredCells(options, self.cell_size, trajectory.T_world_keyframe, self.origin)
        done = itertools.count(1)

        def frames(color: bool) -> Iterator[PosedFrame]:
            for posed in self.posed(trajectory, options.every, color):
                yield posed
                progress.advance(next(done))

        for posed in frames(color=True):
            cells.add(posed)
        return cells.gaussians(frames(color=False))

    def fit_gaussians(self, gaussians: Gaussians, progress: Progress | None = None) -> Gaussians:
        """Layer 2 fitted to the images of all mapped keyframes so far."""
        progress, options, trajectory = progress or Progress(), self.settings.fitting, self.trajectory()
        progress.stage("fitting", options.passes * len(trajectory.keyframes))
        if options.passes == 0 or not len(gaussians):
            return gaussians
        views = self.views(trajectory, range(len(trajectory.keyframes)))
        most = _FITTED_PER_FRAME * len(self.frames_used(trajectory, 1)) + _FITTED_PER_KEYFRAME * len(views)
        made = fitting.fit_gaussians(gaussians, views, self.rasterizer, options, options.passes, progress.advance, most)
        return anchors.anchor_in_place(made, trajectory.T_world_keyframe) if options.means == "free" else made

    @property
    def cell_size(self) -> float:
        """Edge in meters of the cells that hold one Gaussian each."""
        usual = 0.5 * self.settings.occupancy.voxel_size
        if not self.tracker.metric:  # half a voxel may be large in meters
            usual = min(usual, _FINE * capture_base.NOMINAL_DEPTH)
        return float(self.settings.gaussians.cell_size or usual)

    def views(self, trajectory: Trajectory, rows: Iterable[int]) -> list[rendered_views.CapturedView]:
        """Some of the keyframes as they are rendered and compared."""
        device, width = self.rasterizer.device, self.settings.fitting.width
        keyframes, T = self.mapped(trajectory), trajectory.T_world_keyframe
        return [rendered_views.prepare_captured_view(keyframes[row], T[row], width, device) for row in rows]

    def build_features(
        self, gaussians: Gaussians, encoder: Encoder, progress: Progress | None = None
    ) -> NDArray[np.float16]:
        """Layer 3: (N, D) unit features of the Gaussians, fused over the keyframes that see them."""
        trajectory = self.trajectory()
        options = self.settings.language
        keyframes = self.mapped(trajectory)
        return lifting.lift_features(gaussians, keyframes, trajectory.T_world_keyframe, encoder, options, progress)

    def build_occupancy(
        self, gaussians: Gaussians, features: NDArray[np.float16], progress: Progress | None = None
    ) -> Occupancy:
        """Layer 4: voxels with probabilities, evidence, features and colors."""
        progress = progress or Progress()
        trajectory = self.trajectory()
        carving, voxel_size = self.settings.carving, self.settings.occupancy.voxel_size
        progress.stage("occupancy", len(self.frames_used(trajectory, carving.every)))
        frames = self.posed(trajectory, carving.every, color=False)
        return build.build_occupancy(
            gaussians,
            features,
            hide_unconfirmed(frames, gaussians, voxel_size, self.cell_size),
            self.settings.occupancy,
            carving,
            origin=self.origin,
            progress=progress.advance,
            least_scale=anchors.compute_least_scale(
                self.settings.gaussians,
                self.cell_size,
                voxel_size,
            ),
        )

    def refine_occupancy(
        self,
        occupancy: Occupancy,
        gaussians: Gaussians,
        features: NDArray[np.float16],
        encoder: Encoder,
        progress: Progress | None = None,
    ) -> Occupancy:
        """Layer 4 with smaller voxels where they show more, if the configuration asks for them."""
        finest = self.settings.occupancy.finest
        if finest is None:
            return occupancy
        trajectory, progress = self.trajectory(), progress or Progress()
        return adaptive_voxels.build_adaptive(
            occupancy,
            gaussians,
            features,
            lambda: self.posed(trajectory, 0),
            trajectory.T_world_keyframe,
            lambda more: self.build_features(more, encoder, progress),
            self.settings,
            finest,
            progress,
        )

    def _read(self, index: int) -> Frame:
        """A frame of the capture as ``add`` tracks it."""
        return self.complete(self.capture[index])

    def complete(self, frame: Frame) -> Frame:
        """The frame with the camera as the tracker knows it, with depth, and with the sensor of this depth."""
        return self.depth.complete(self.tracker.prepare_frame(replace(frame, sensor=self.sensor)))
