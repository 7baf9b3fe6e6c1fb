"""From a capture to a map: feeds the mapper from the capture, refines the poses of the whole scan, and builds layers
2-4 once. The work folder ``MAP.partial`` takes the map's name when the map is complete."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import __version__
from ..capture import Capture, open_capture, select_frames
from ..capture.checks.depth_units import settle_depth_unit
from ..capture.checks.file_heads import check_heads
from ..capture.focal_correction import Reregistered
from ..capture.rgbd_frames import RgbdFrames
from ..core.errors import CaptureError, FrameError, Interrupted, MapError, TrackingError, is_interrupt
from ..core.progress import Progress
from ..core.sampling import spread_evenly
from ..core.types import Frame
from ..language.encoders.base import Encoder
from ..language.word_models import choose_encoder
from ..query.scan_map import Map, load_map
from ..settings import config
from ..settings.config import Settings
from ..storage.work_folder import WorkFolder
from ..tracking.rgbd.measured_pairs import MeasuredPair, measure_pairs
from .calibration import estimate_unknown_focal, register_color
from .checks import check, check_brightness, check_projection
from .mapper import Mapper
from .run_stages import STAGES, Run
from .saving import absolute
from .sensor_choice import choose_sensor
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
    unsuited = check_projection(resolved)
    work.warn(progress, *resolved.notices, *([unsuited] if unsuited else []))
    try:
        opened = _open(capture, resolved, progress, work)
        resolved, reason = choose_tracker(resolved, opened)
        progress.note(reason)
        resolved, words = choose_encoder(resolved)
        progress.note(words)
        opened, resolved = _know_camera(opened, resolved, progress, work)
        resolved, sensed = choose_sensor(resolved, opened)
        progress.note(sensed)
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
    found = estimate_unknown_focal(capture, select_frames(capture))
    if found.focal_px is None:
        raise CaptureError(found.notice.text)
    if found.notice.code == "intrinsics-unknown":  # the tracking stage tells it
        return capture, settings
    work.warn(progress, found.notice)
    settings = settings.changed("capture", focal=found.focal_px)
    known = open_capture(capture.path, settings.capture, settings.backends.get("capture"))
    assert isinstance(known, RgbdFrames)
    known.units_per_meter = capture.units_per_meter
    return known, settings


def _look(capture: Capture) -> list[Frame]:
    """A few of the selected frames, of those that can be read."""
    frames = select_frames(capture)
    found = []
    for row in spread_evenly(len(frames), _LOOKED_AT):
        with contextlib.suppress(FrameError):
            found.append(capture[frames[row]])
    return found


def _calibrate(
    capture: Capture, settings: Settings, progress: Progress, work: WorkFolder
) -> tuple[Capture, Sequence[MeasuredPair]]:
    """The capture with color registered to the depth images, and pairs of frames whose motion depth measures; none if
    nothing is to be compared with them."""
    if not capture.has_depth:
        return capture, ()
    ratio, given = settings.capture.color_focal, settings.tracking.backend in GIVEN
    if ratio is not None:
        capture = capture if ratio == 1 else Reregistered(capture, ratio)
        if not given:
            return capture, ()
    progress.stage("calibration")
    if dark := check_brightness(_look(capture), capture.path):
        work.warn(progress, dark)
    frames = select_frames(capture)
    pairs = measure_pairs(capture, frames)
    if ratio is None:
        capture, notices = register_color(capture, frames, pairs)
        work.warn(progress, *notices)
    return capture, pairs if given else ()
