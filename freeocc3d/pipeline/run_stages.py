"""The stages of a run, in the order of the paper's layers. Each saves its result in the work folder; a resumed run with
the same configuration loads it from there."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..capture import read_ahead, select_frames
from ..core.errors import CaptureError, FrameError, TrackingError
from ..core.progress import Progress
from ..core.types import Gaussians, Occupancy, Trajectory
from ..core.warnings import Notice
from ..language import scene_vocabulary
from ..language.encoders.base import Encoder
from ..storage.work_folder import WorkFolder
from ..tracking.pose_check import check_poses
from ..tracking.rgbd.measured_pairs import MeasuredPair
from .checks import warn_of_camera, warn_of_scale, warn_of_trajectory
from .frame_losses import explain_losses
from .live_snapshots import LiveSnapshots
from .mapper import Mapper
from .saving import evenly, save
from .tracking_choice import GIVEN

_CHECKPOINT_FRAMES = 50


@dataclass
class Run:
    """One reconstruction: the objects that its stages use, and their results."""

    mapper: Mapper
    encoder: Encoder
    work: WorkFolder
    progress: Progress
    tracking_reason: str = ""
    """Why this tracker was chosen; empty if the configuration names it."""
    snapshots: LiveSnapshots = field(init=False)
    trajectory: Trajectory = field(init=False)
    vocabulary: dict[str, Any] | None = None
    gaussians: Gaussians = field(init=False)
    features: NDArray[np.float16] = field(init=False)
    occupancy: Occupancy = field(init=False)

    def __post_init__(self) -> None:
        self.snapshots = LiveSnapshots(self.mapper, self.work.folder)

    def check_poses(self, pairs: Sequence[MeasuredPair]) -> None:
        """Say how many frames have a pose that is taken as it is, and compare these poses with measured pairs of
        frames. Raises TrackingError."""
        capture, settings = self.mapper.capture, self.mapper.settings
        poses = self.mapper.tracker.poses_ahead() if settings.tracking.backend in GIVEN else None
        if poses is None:
            return
        used = select_frames(capture)
        posed = int(np.isfinite(poses[list(used)]).all(axis=(1, 2)).sum())
        self.progress.note(f"{posed} of {len(used)} frames have a given pose.")
        if pairs and (notice := check_poses(poses, pairs, str(capture.path))):
            self.warn(notice)

    def warn(self, *notices: Notice) -> None:
        """Show the notices now, and in the map's report."""
        self.work.warn(self.progress, *notices)


def track(run: Run) -> None:
    """Layer 1: poses of all used frames, with checkpoints."""
    mapper, work, progress = run.mapper, run.work, run.progress
    capture = mapper.capture
    if not (capture.intrinsics_known or mapper.tracker.estimates_camera):
        run.warn(warn_of_camera(capture))
    with work.timed("tracking"):
        frames = select_frames(capture)
        if mapper.offline:
            mapper.prepare(work.begin_offline(), frames, progress)
        run.warn(*mapper.tracker.warnings)
        state = work.restore_tracking()
        first = 0 if state is None else mapper.restore(state)
        progress.stage("tracking", len(frames))
        _track_frames(run, frames, first)
    if len(mapper.keyframes) == 0:
        raise TrackingError(
            f"No frame of {capture.path} could be used as a start. {_explain_losses(run, mapper.trajectory())}"
        )


def _track_frames(run: Run, frames: range, first: int) -> None:
    """Track the frames from the ``first`` on, and read ahead. Leaves out a frame that cannot be read."""
    mapper, work, progress = run.mapper, run.work, run.progress
    stream = read_ahead(mapper.capture, frames[first:])
    done = first
    try:
        for done, (index, frame) in enumerate(stream, start=first + 1):
            if isinstance(frame, FrameError):
                _leave_out(run, index, frame, len(frames))
            else:
                mapper.add(frame)
            progress.advance(done)
            run.snapshots.offer(f"Being made: poses, frame {done} of {len(frames)}")
            if done % _CHECKPOINT_FRAMES == 0:
                work.save_tracking(mapper.state(done))
    finally:
        stream.close()
        mapper.settle()
    if done > first:
        work.save_tracking(mapper.state(done))


def _leave_out(run: Run, index: int, error: FrameError, count: int) -> None:
    """Record a broken frame. Raises CaptureError if too many of ``count`` frames are broken."""
    broken = run.work.broken
    broken[index] = str(error)
    run.progress.warn(str(error))
    if len(broken) > run.mapper.capture.options.max_broken * count:
        raise CaptureError(
            f"{len(broken)} of {count} frames are unreadable, the last: {error} Repair the capture, or raise "
            "capture.max_broken."
        )


def refine_poses(run: Run) -> None:
    """Layer 1: make all poses consistent with each other."""
    mapper, work = run.mapper, run.work
    with work.timed("refinement"):
        run.progress.stage("refinement")
        if not mapper.refined:
            mapper.refine()
            work.save_tracking(mapper.state(len(select_frames(mapper.capture))))
        mapper.tracker.release()
    run.snapshots.offer("Being made: poses are done, Gaussians follow")
    trajectory = mapper.trajectory()
    status = trajectory.status.copy()
    status[list(work.broken)] = "broken"
    run.trajectory = dataclasses.replace(trajectory, status=status)


def name_scene(run: Run) -> None:
    """Ask a vision-language model, if the configuration has one, to name what some keyframes show. Saves each
    answer."""
    mapper, progress = run.mapper, run.progress
    options = mapper.settings.vocabulary
    namer = scene_vocabulary.load_namer(options)
    if namer is None:
        return
    frames = mapper.trajectory().keyframes
    chosen = mapper.keyframes.only(frames[evenly(len(frames), options.keyframes)])
    progress.stage("vocabulary", len(chosen))
    with run.work.timed("vocabulary"):
        run.vocabulary, warnings = namer.names(chosen, run.work.answers, progress.advance)
    run.warn(*warnings)


def build_gaussians(run: Run) -> None:
    """Layer 2: Gaussians anchored at the surface, and fitted to the images."""

    def build() -> Gaussians:
        with run.work.timed("gaussians"):
            anchored = run.mapper.anchor_gaussians(run.progress)
        run.snapshots.offer("Being made: Gaussians are being fitted; words and voxels follow", anchored)
        with run.work.timed("fitting"):
            return run.mapper.fit_gaussians(anchored, run.progress)

    run.gaussians = run.work.gaussians(build)
    if len(run.gaussians) == 0:
        raise TrackingError(
            f"The {len(run.mapper.keyframes)} keyframes of {run.mapper.capture.path} hold too little depth for a map: "
            "is its depth in meters after scaling (capture.depth_scale), and nearer than capture.max_depth?"
        )


def lift_features(run: Run) -> None:
    """Layer 3: features of the Gaussians."""
    with run.work.timed("language"):
        run.features = run.work.features(lambda: run.mapper.build_features(run.gaussians, run.encoder, run.progress))


def build_occupancy(run: Run) -> None:
    """Layer 4: voxels, smaller where they show more. Saves nothing, since the map follows at once."""
    with run.work.timed("occupancy"):
        occupancy = run.mapper.build_occupancy(run.gaussians, run.features, run.progress)
        occupancy = run.mapper.refine_occupancy(occupancy, run.gaussians, run.features, run.encoder, run.progress)
    run.mapper.cache.clear()  # the map needs the disk's space
    if not len(occupancy.colors):
        raise TrackingError(
            f"No voxel of {run.mapper.capture.path} is occupied: is its depth in the right unit (capture.depth_scale), "
            "and is occupancy.voxel_size smaller than the scene?"
        )
    run.occupancy = occupancy


def save_map(run: Run) -> None:
    """Write the map, and warn of what it lacks."""
    run.warn(*warn_of_trajectory(run.trajectory, _explain_losses(run, run.trajectory)))
    if not run.mapper.tracker.metric:
        run.warn(warn_of_scale())
    run.progress.stage("saving")
    save(
        run.work,
        run.mapper,
        run.trajectory,
        run.gaussians,
        run.features,
        run.occupancy,
        run.encoder,
        run.vocabulary,
        run.tracking_reason,
    )


def _explain_losses(run: Run, trajectory: Trajectory) -> str:
    """Why frames were lost, a sentence; empty if none were."""
    mapper = run.mapper
    given = mapper.settings.tracking.backend in GIVEN
    return explain_losses(mapper.capture, trajectory, mapper.tracker.poses_ahead(), given, mapper.complete)


STAGES: dict[str, Callable[[Run], None]] = {
    "tracking": track,
    "refinement": refine_poses,
    "vocabulary": name_scene,
    "gaussians": build_gaussians,
    "language": lift_features,
    "occupancy": build_occupancy,
    "saving": save_map,
}
"""The stages of a run, in this order."""
