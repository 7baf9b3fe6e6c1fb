"""From a capture to a map: the mapper fed from the capture, one refinement over the whole scan, one clean pass of
layers 2-4. The work lies in ``MAP.partial`` until it is whole, then takes the map's name."""

from __future__ import annotations

import dataclasses
import errno
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..capture import Capture, check_depth_scale, open_capture, read_ahead, select_frames
from ..capture import base as capture_base
from ..capture.focal_correction import Reregistered
from ..core.errors import CaptureError, FrameError, Interrupted, MapError, TrackingError
from ..core.progress import Progress
from ..core.types import Gaussians, Trajectory
from ..editing import scaling
from ..language import scene_vocabulary
from ..language.encoders.base import Encoder
from ..settings import config
from ..settings.config import Config
from ..storage.keyframes import Keyframes
from ..storage.store import Map, load_map
from ..storage.work_folder import WorkFolder
from ..tracking.rgbd import focal_calibration
from .backends import load_backend, options_of
from .checks import check, warn_of_result
from .mapper import Mapper
from .saving import absolute, evenly, save

_CHECKPOINT_FRAMES = 50


def reconstruct(
    capture: str | Path,
    output: str | Path,
    settings: Config | dict[str, Any] | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
) -> Map:
    """Turn the capture in a folder into a map folder, and return the map.

    settings: a configuration as ``config.load`` gives it, or any part of one, {"section": {"key": value}}.
    overwrite: replace an existing map, and drop an interrupted run's work.  resume: go on with an interrupted run.
    Raises FreeOccError; Interrupted after Ctrl-C, with the work done so far kept for ``resume``.
    """
    progress = progress or Progress()
    resolved = config.resolve(settings or {})
    check(resolved)
    output = Path(output)
    work = WorkFolder.open(output, overwrite, resume)
    try:
        opened = _open(capture, resolved, progress, work)
        work.begin([absolute(opened.path), len(opened), __version__], resolved)
        with work.timed("calibration"):
            opened = _registered(opened, resolved, progress, work)
        return _run(opened, resolved, output, work, progress)
    except TrackingError:
        work.discard()  # nothing in it is of use
        raise
    except (KeyboardInterrupt, SystemError) as error:
        if not _is_interrupt(error):
            raise
        kept = f"The work up to the last checkpoint is in {work.folder}: run the same command with --resume to go on."
        raise Interrupted(
            f"Stopped. {kept if work.kept else 'There was no checkpoint yet, so nothing is kept.'}"
        ) from error
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else str(error.strerror or error).lower()
        raise MapError(
            f"Cannot write to {error.filename or work.folder}: {reason}. The work so far is in {work.folder}: "
            "make room, then run the same command with --resume."
        ) from error
    finally:
        work.drop_if_empty()


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether it is Ctrl-C, which leaves the call of a compiled function as a SystemError that it caused."""
    return isinstance(error, KeyboardInterrupt) or (error is not None and _is_interrupt(error.__cause__))


def _run(capture: Capture, settings: Config, output: Path, work: WorkFolder, progress: Progress) -> Map:
    """The stages in order; each leaves a result in the work folder, which a resumed run picks up."""
    mapper = Mapper(settings, capture, work.folder)
    encoder: Encoder = load_backend(settings, "language", "encoder", capture)

    if not (capture.intrinsics_known or mapper.tracker.estimates_camera):
        text = (
            f"Nothing says what camera took {capture.path}: its focal length is "
            f"{'what the images roughly state' if capture.focal_stated else 'a guess'}, and what is mapped is bent as "
            "far as that is wrong. Give capture.intrinsics, if you have them."
        )
        work.warnings.append(text)
        progress.warn(text)
    with work.timed("tracking"):
        _track(mapper, work, progress)
    with work.timed("refinement"):
        progress.stage("refinement")
        mapper.refine()
    trajectory = _with_broken(mapper.trajectory(), work.broken)
    vocabulary = _vocabulary(mapper, work, progress)
    gaussians = work.gaussians(lambda: _layer_2(mapper, work, progress))
    if len(gaussians) == 0:
        raise TrackingError(
            f"The {len(mapper.keyframes)} keyframes of {capture.path} hold too little depth for a map: is its depth in "
            "metres after scaling (capture.depth_scale), and nearer than capture.max_depth?"
        )
    with work.timed("language"):
        features = work.features(lambda: mapper.build_features(gaussians, encoder, progress))
    with work.timed("occupancy"):
        occupancy = mapper.build_occupancy(gaussians, features, progress)
        occupancy = mapper.refine_occupancy(occupancy, gaussians, features, encoder, progress)
    if not len(occupancy.colors):
        raise TrackingError(
            f"No voxel of {capture.path} is occupied: is its depth in the right unit (capture.depth_scale), and is "
            "occupancy.voxel_size smaller than the scene?"
        )
    warn_of_result(trajectory, progress, work)
    if not mapper.tracker.metric:
        work.warnings.append(scaling.UNKNOWN)
        progress.warn(scaling.UNKNOWN)
    progress.stage("saving")
    save(work, mapper, trajectory, gaussians, features, occupancy, encoder, vocabulary)
    work.finish(output)
    return load_map(output)


def _vocabulary(mapper: Mapper, work: WorkFolder, progress: Progress) -> dict[str, Any] | None:
    """Names of what the mapped keyframes show, as the map keeps them; None if no model is to be asked."""
    options: scene_vocabulary.Options = options_of(scene_vocabulary, mapper.settings["vocabulary"])
    namer = scene_vocabulary.load_namer(options)
    if namer is None:
        return None
    frames = mapper.trajectory().keyframes
    chosen = mapper.keyframes.only(frames[evenly(len(frames), options.keyframes)])
    progress.stage("vocabulary", len(chosen))
    with work.timed("vocabulary"):
        found, warnings = namer.names(chosen, work.answers, progress.advance)
    for text in warnings:
        work.warnings.append(text)
        progress.warn(text)
    return found


def _layer_2(mapper: Mapper, work: WorkFolder, progress: Progress) -> Gaussians:
    with work.timed("gaussians"):
        anchored = mapper.anchor_gaussians(progress)
    with work.timed("fitting"):
        return mapper.fit_gaussians(anchored, progress)


def _track(mapper: Mapper, work: WorkFolder, progress: Progress) -> None:
    """Layer 1 over all frames that are used, with checkpoints."""
    capture = mapper.capture
    frames = select_frames(capture)
    if mapper.offline:
        mapper.prepare(work.begin_offline(), frames, progress)
        for text in mapper.tracker.warnings:
            work.warnings.append(text)
            progress.warn(text)
    first = _restore(mapper, work)
    progress.stage("tracking", len(frames))
    allowed = capture.options.max_broken * len(frames)
    stream = read_ahead(capture, frames[first:])
    done = first
    try:
        for index, frame in stream:
            if isinstance(frame, FrameError):
                work.broken[index] = str(frame)
                progress.warn(str(frame))
                if len(work.broken) > allowed:
                    raise CaptureError(
                        f"{len(work.broken)} of {len(frames)} frames are unreadable, the last: {frame} Repair the "
                        "capture, or raise capture.max_broken."
                    )
            else:
                mapper.add(frame)
            done += 1
            progress.advance(done)
            if done % _CHECKPOINT_FRAMES == 0:
                _checkpoint(mapper, work, done)
    finally:
        stream.close()
    if done > first:
        _checkpoint(mapper, work, done)
    if len(mapper.keyframes) == 0:
        raise TrackingError(
            f"No frame of {capture.path} could be used as a start: their depth is empty. Is it in other units "
            "(capture.depth_scale), or all beyond capture.max_depth?"
        )


def _with_broken(trajectory: Trajectory, broken: dict[int, str]) -> Trajectory:
    """The trajectory with the status of frames that could not be decoded."""
    status = trajectory.status.copy()
    status[list(broken)] = "broken"
    return dataclasses.replace(trajectory, status=status)


def _checkpoint(mapper: Mapper, work: WorkFolder, done: int) -> None:
    mapper.keyframes.save_index()
    work.save_tracking({"done": np.array(done), "keyframes": np.array(len(mapper.keyframes)), **mapper.tracker.state()})


def _restore(mapper: Mapper, work: WorkFolder) -> int:
    """Take up the last checkpoint of layer 1, if it is valid; returns the number of frames that are done."""
    state = work.restore_tracking()
    if state is None:
        return 0
    keyframes = Keyframes.load(mapper.keyframes.folder)
    keyframes.truncate(int(state.pop("keyframes")))
    done = int(state.pop("done"))
    mapper.keyframes = keyframes
    mapper.tracker.restore(state, keyframes)
    return done


def _open(capture: str | Path, settings: Config, progress: Progress, work: WorkFolder) -> Capture:
    section = settings["capture"]
    opened = open_capture(capture, options_of(capture_base, config.options(settings, "capture")), section)
    select_frames(opened)
    warning = check_depth_scale(opened) if opened.has_depth else None
    for text in (*opened.warnings, *([warning] if warning else [])):
        work.warnings.append(text)
        progress.warn(text)
    return opened


def _registered(capture: Capture, settings: Config, progress: Progress, work: WorkFolder) -> Capture:
    """The capture with colour brought to the depth's pixels, if its cameras' focal lengths differ."""
    ratio = settings["capture"]["color_focal"]
    if not capture.has_depth:
        return capture
    if ratio is None:
        progress.stage("calibration")
        ratio = focal_calibration.estimate_color_focal(capture, select_frames(capture))
        if ratio != 1:
            text = (
                f"Colour and depth of {capture.path} fit each other only if the colour camera's focal length is "
                f"{ratio:.3f} of what its files say: colour is resampled so (capture.color_focal=1 leaves it as it is)."
            )
            work.warnings.append(text)
            progress.warn(text)
    return capture if ratio == 1 else Reregistered(capture, ratio)
