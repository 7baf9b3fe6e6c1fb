"""From a capture to a map: feeds the mapper from the capture, refines the poses of the whole scan, and builds layers
2-4 once. The work folder ``MAP.partial`` takes the map's name when the map is complete."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..capture import Capture, open_capture, select_frames
from ..capture.checks.depth_units import settle_depth_unit
from ..capture.checks.file_heads import check_heads
from ..capture.checks.registration_check import check_registration
from ..capture.focal_correction import Reregistered
from ..capture.rgbd_frames import RgbdFrames
from ..core.errors import CaptureError, FrameError, Interrupted, MapError, TrackingError, is_interrupt
from ..core.progress import Progress
from ..core.types import Frame
from ..language.encoders.base import Encoder
from ..query.scan_map import Map, load_map
from ..settings import config
from ..settings.config import Settings
from ..storage.work_folder import WorkFolder
from ..tracking.rgbd import focal_calibration, self_calibration
from ..tracking.rgbd.measured_pairs import MeasuredPair, measure_pairs
from .checks import check, check_brightness, explain_unknown_camera, warn_of_color_focal, warn_of_estimated_focal
from .mapper import Mapper
from .run_stages import STAGES, Run
from .saving import absolute
from .tracking_choice import GIVEN, choose_tracker

_LOOKED_AT = 5  # frames


def reconstruct(
    capture: str | Path,
    output: str | Path,
    settings: Settings | dict[str, Any] | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
) -> Map:
    """Turn the capture in a folder into a map folder, and return the map.

    settings: from ``config.load``, or any part as plain values, {"section": {"key": value}}.
    overwrite: replace an existing map, and drop an interrupted run's work.  resume: continue an interrupted run.
    Raises FreeOccError; after Ctrl-C, Interrupted, and the work so far is kept for ``resume``.
    """
    progress = progress or Progress()
    resolved = config.resolve(settings or {})
    check(resolved)
    output = Path(output)
    work = WorkFolder.open(output, overwrite, resume)
    work.warn(progress, *resolved.notices)
    try:
        opened = _open(capture, resolved, progress, work)
        resolved, reason = choose_tracker(resolved, opened)
        progress.note(reason)
        opened, resolved = _know_camera(opened, resolved, progress, work)
        work.begin([absolute(opened.path), len(opened), __version__], resolved, progress)
        if not work.complete:
            with work.timed("calibration"):
                opened, pairs = _calibrate(opened, resolved, progress, work)
            run = _prepare(opened, resolved, work, progress, reason)
            run.check_poses(pairs)
            for stage in STAGES.values():
                stage(run)
            work.mark_complete()
        work.finish(output)
        return load_map(output)
    except TrackingError:
        work.discard()  # it holds nothing useful
        raise
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interrupt(error):
            raise
        kept = f"The work up to the last checkpoint is in {work.folder}: continue with the same command and --resume."
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
        work.close()


def _prepare(capture: Capture, settings: Settings, work: WorkFolder, progress: Progress, reason: str) -> Run:
    encoder: Encoder = settings.load_backend("language", capture)
    return Run(Mapper(settings, capture, work.folder), encoder, work, progress, reason)


def _open(capture: str | Path, settings: Settings, progress: Progress, work: WorkFolder) -> Capture:
    opened = open_capture(capture, settings.capture, settings.backends.get("capture"))
    broken = check_heads(opened, select_frames(opened))
    work.warn(progress, *([broken] if broken else []))
    warning = settle_depth_unit(opened)
    work.warn(progress, *opened.warnings, *([warning] if warning else []))
    return opened


def _know_camera(
    capture: Capture, settings: Settings, progress: Progress, work: WorkFolder
) -> tuple[Capture, Settings]:
    """The capture with depth, and the settings, with a focal length that the scan shows if nothing states it. Raises
    CaptureError if the scan does not show it."""
    if not isinstance(capture, RgbdFrames) or not capture.has_depth or capture.intrinsics_known:
        return capture, settings
    progress.stage("self-calibration")
    frames = select_frames(capture)
    stored, guess = capture.rig(frames[0]).color.camera, capture.registration(frames[0]).intrinsics
    found = self_calibration.estimate_focal(capture, frames)
    if (found is None or not found.sure) and capture.focal_stated:
        return capture, settings
    if found is None or not found.sure:
        roughly = "" if found is None else found.describe(stored.fx / guess.fx)
        raise CaptureError(explain_unknown_camera(capture, (stored.width, stored.height), roughly))
    focal_px = round(stored.fx * found.focal_px / guess.fx, 1)
    work.warn(progress, warn_of_estimated_focal(capture, focal_px, found.uncertainty))
    settings = settings.changed("capture", focal=focal_px)
    known = open_capture(capture.path, settings.capture, settings.backends.get("capture"))
    assert isinstance(known, RgbdFrames)
    known.units_per_meter = capture.units_per_meter
    return known, settings


def _look(capture: Capture) -> list[Frame]:
    """A few of the selected frames, of those that can be read."""
    frames = select_frames(capture)
    found = []
    for row in np.unique(np.linspace(0, len(frames) - 1, _LOOKED_AT).astype(int)).tolist():
        with contextlib.suppress(FrameError):
            found.append(capture[frames[row]])
    return found


def _calibrate(
    capture: Capture, settings: Settings, progress: Progress, work: WorkFolder
) -> tuple[Capture, Sequence[MeasuredPair]]:
    """The capture with color registered to the depth images, if the focal lengths of its cameras differ, and pairs of
    frames whose motion depth measures; none if nothing is to be compared with them."""
    ratio = settings.capture.color_focal
    given = settings.tracking.backend in GIVEN
    if not capture.has_depth or (ratio is not None and not given):
        return (capture if ratio in (None, 1) or not capture.has_depth else Reregistered(capture, ratio)), ()
    progress.stage("calibration")
    if dark := check_brightness(_look(capture), capture.path):
        work.warn(progress, dark)
    pairs = measure_pairs(capture, select_frames(capture))
    if ratio is None:
        ratio = focal_calibration.estimate_color_focal(pairs)
        if ratio != 1:
            work.warn(progress, warn_of_color_focal(capture, ratio))
    registered = capture if ratio == 1 else Reregistered(capture, ratio)
    if settings.capture.color_focal is None and (notice := check_registration(registered, select_frames(capture))):
        work.warn(progress, notice)
    return registered, pairs if given else ()
