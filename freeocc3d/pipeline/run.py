"""The only file that knows all four layers: capture -> track -> gaussians -> language -> occupancy -> store.

A ``Mapper`` takes frames one by one: it tracks each and keeps the keyframes on disk, and ``build`` gives layers 2-4 of
what was seen so far. ``reconstruct`` is that Mapper fed from a capture, followed by one refinement over the whole scan
and one clean pass of layers 2-4. Its work lies in ``MAP.partial`` until it is whole, then takes its name.
"""

from __future__ import annotations

import dataclasses
import errno
import itertools
import json
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..capture import Capture, check_depth_scale, open_capture, read_ahead, used_frames
from ..capture import base as capture_base
from ..capture.focal_correction import Reregistered
from ..core.errors import CaptureError, FrameError, Interrupted, MapError, TrackingError
from ..core.progress import Progress
from ..core.tum_files import write_tum
from ..core.types import Frame, Gaussians, Occupancy, PosedFrame, Submap, Trajectory
from ..depth import multi_view_stereo
from ..editing import adaptive_voxels, scaling
from ..gaussians import anchors, fitting, rendered_views
from ..gaussians.rasterizers.base import Rasterizer
from ..language import lifting, scene_vocabulary
from ..language.encoders.base import Encoder
from ..language.feature_codec import Codec
from ..occupancy import build, carve, splat
from ..occupancy.gravity_frame import gravity_frame
from ..occupancy.up_direction import estimate_up, turned_back
from ..settings import config, registry
from ..settings.config import Config
from ..storage import store
from ..storage.keyframes import Keyframes
from ..storage.store import Map, load_map
from ..storage.work_folder import WorkFolder
from ..tracking.base import Tracked, Tracker
from ..tracking.rgbd import focal_calibration
from ..viewer import render_pictures, trajectory_picture

_CHECKPOINT_FRAMES = 50
_FEW_TRACKED = 0.5
_FINE = 0.01
"""Edge of cells over the usual depth, where the scale is unknown: about what stereo can tell apart."""
_MEASURED_VIEWS = 24
"""Keyframes, at most, that are rendered to say how well the Gaussians show what was captured."""


class Mapper:
    """Takes frames one by one. ``folder`` receives the keyframes; what is in memory grows with keyframes only."""

    def __init__(self, settings: Config, capture: Capture, folder: Path):
        self.settings = settings
        self.capture = capture
        self.keyframes = Keyframes(folder / store.KEYFRAMES)
        self.tracker: Tracker = _load_backend(settings, "tracking", "backend", capture)
        if self.tracker.needs_depth and not capture.has_depth:
            raise TrackingError(
                f"tracking.backend={settings['tracking']['backend']} needs depth, which {capture.path} has none of (or "
                "capture.depth=false): estimate poses from colour with tracking.backend=colmap, or give them (known, "
                "file)."
            )
        self.tracker.stereo = _options(multi_view_stereo, settings["tracking"]["stereo"])
        self.rasterizer: Rasterizer = _load_backend(settings, "fitting", "rasterizer")
        self._fitted: tuple[Gaussians, Trajectory] | None = None

    def add(self, frame: Frame) -> Tracked:
        """Track the next frame, and keep it if it is a keyframe."""
        frame = self.tracker.completed(frame)
        tracked = self.tracker.track(frame)
        if tracked.status == "keyframe":
            self.keyframes.append(frame)
        return tracked

    def refine(self) -> None:
        """Make all poses so far consistent with each other."""
        self.tracker.optimize()

    def trajectory(self) -> Trajectory:
        """Poses so far, one row per frame of the capture."""
        return self.tracker.trajectory(self.capture.timestamps)

    def mapped(self, trajectory: Trajectory) -> Keyframes:
        """The keyframes that are mapped: those of the largest submap."""
        return self.keyframes.only(trajectory.keyframes)

    def frames_used(self, trajectory: Trajectory, every: int) -> NDArray[np.int64]:
        """Indices of the mapped keyframes and of every n-th mapped frame that was tracked (0 = none of these)."""
        measured = np.flatnonzero(np.isin(trajectory.status, ("keyframe", "tracked", "relocalised")))
        return np.union1d(trajectory.keyframes, measured[::every] if every else [])

    def posed(self, trajectory: Trajectory, every: int) -> Iterator[PosedFrame]:
        """Those frames. Keyframes are read as they were kept, the others from the capture; one that cannot be decoded
        any more is left out."""
        keyframes, own = self.mapped(trajectory), trajectory.keyframes.tolist()
        between = np.setdiff1d(self.frames_used(trajectory, every), own)
        stream = read_ahead(self.capture, between.tolist())
        try:
            following = next(stream, None)
            for row, (frame, T) in enumerate(zip(keyframes, trajectory.T_world_keyframe, strict=True)):
                yield PosedFrame(frame, T, row)
                while following is not None and (row + 1 == len(own) or following[0] < own[row + 1]):
                    index, found = following
                    if not isinstance(found, FrameError):
                        yield PosedFrame(self.tracker.completed(found), trajectory.T_world_cam[index], row)
                    following = next(stream, None)
        finally:
            stream.close()

    def build_gaussians(self, progress: Progress | None = None) -> Gaussians:
        """Layer 2 from the mapped keyframes so far at their present poses: anchored, and fitted to all of them."""
        return self.fit_gaussians(self.anchor_gaussians(progress), progress)

    def anchor_gaussians(self, progress: Progress | None = None, every: int | None = None) -> Gaussians:
        """Layer 2 as it is initialised: Gaussians anchored at the surface that the mapped frames so far show, every
        n-th of them (0 = keyframes alone; by default what the configuration says)."""
        progress = progress or Progress()
        trajectory = self.trajectory()
        options: anchors.Options = _options(anchors, self.settings["gaussians"])
        every = options.every if every is None else every
        progress.stage("gaussians", 2 * len(self.frames_used(trajectory, every)))
        cells = anchors.AnchoredCells(options, self.cell_size, trajectory.T_world_keyframe)
        done = itertools.count(1)

        def frames() -> Iterator[PosedFrame]:
            for posed in self.posed(trajectory, every):
                yield posed
                progress.advance(next(done))

        for posed in frames():
            cells.add(posed)
        return cells.gaussians(frames())

    def fit_gaussians(self, gaussians: Gaussians, progress: Progress | None = None) -> Gaussians:
        """Layer 2 fitted to the images of all mapped keyframes so far."""
        progress = progress or Progress()
        trajectory, passes = self.trajectory(), self.fit_options.passes
        progress.stage("fitting", passes * len(trajectory.keyframes))
        return self._fit(gaussians, trajectory, passes, progress)

    def update_gaussians(self) -> Gaussians:
        """Layer 2 kept current while frames come in: what was fitted before is carried over to the keyframes' present
        poses, new surface is added, and all is fitted to the last ``fitting.window`` keyframes."""
        trajectory, options = self.trajectory(), self.fit_options
        gaussians = self.anchor_gaussians(every=0)
        if self._fitted is not None:
            before, then = self._fitted
            count = len(then.keyframes)
            if np.array_equal(trajectory.keyframes[:count], then.keyframes):  # else submaps were merged: start anew
                moved = anchors.reanchored(before, then.T_world_keyframe, trajectory.T_world_keyframe[:count])
                gaussians = fitting.carried_over(gaussians, moved, self.cell_size)
        window = trajectory.only_keyframes(trajectory.keyframes[-options.window :])
        gaussians = self._fit(gaussians, window, options.window_passes, Progress())
        self._fitted = gaussians, trajectory
        return gaussians

    @property
    def cell_size(self) -> float:
        """Edge in metres of the cells that hold one Gaussian each."""
        usual = 0.5 * self.settings["occupancy"]["voxel_size"]
        if not self.tracker.metric:  # half a voxel may turn out to be much in metres
            usual = min(usual, _FINE * capture_base.NOMINAL_DEPTH)
        return float(self.settings["gaussians"]["cell_size"] or usual)

    @property
    def fit_options(self) -> fitting.Options:
        """The configuration's."""
        options: fitting.Options = _options(fitting, config.options(self.settings, "fitting"))
        return options

    def views(self, trajectory: Trajectory) -> list[rendered_views.View]:
        """The keyframes as they are rendered and compared."""
        device, width = self.rasterizer.device, self.fit_options.width
        posed = zip(self.mapped(trajectory), trajectory.T_world_keyframe, strict=True)
        return [rendered_views.view_of(frame, T, width, device) for frame, T in posed]

    def _fit(self, gaussians: Gaussians, trajectory: Trajectory, passes: int, progress: Progress) -> Gaussians:
        """Fitted to the trajectory's keyframes, ``passes`` times each."""
        options = self.fit_options
        if passes == 0 or not len(gaussians):
            return gaussians
        made = fitting.fitted(gaussians, self.views(trajectory), self.rasterizer, options, passes, progress.advance)
        if options.means == "free":
            made = anchors.anchored_where_they_are(made, self.trajectory().T_world_keyframe)
        return made

    def build_features(
        self, gaussians: Gaussians, encoder: Encoder, progress: Progress | None = None
    ) -> NDArray[np.float16]:
        """Layer 3: (N, D) unit features of the Gaussians, fused over the keyframes that see them."""
        trajectory = self.trajectory()
        options: lifting.Options = _options(lifting, config.options(self.settings, "language"))
        keyframes = self.mapped(trajectory)
        return lifting.lift(gaussians, keyframes, trajectory.T_world_keyframe, encoder, options, progress)

    def build_occupancy(
        self, gaussians: Gaussians, features: NDArray[np.float16], progress: Progress | None = None
    ) -> Occupancy:
        """Layer 4: voxels with probabilities, evidence, features and colours."""
        progress = progress or Progress()
        trajectory = self.trajectory()
        carving: carve.Options = _options(carve, self.settings["carving"])
        progress.stage("occupancy", len(self.frames_used(trajectory, carving.every)))
        return build.build_occupancy(
            gaussians,
            features,
            self.posed(trajectory, carving.every),
            _options(splat, self.settings["occupancy"]),
            carving,
            progress=progress.advance,
            least_scale=anchors.least_scale(
                _options(anchors, self.settings["gaussians"]), self.cell_size, self.settings["occupancy"]["voxel_size"]
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
        finest = self.settings["occupancy"]["finest"]
        if finest is None:
            return occupancy
        trajectory, progress = self.trajectory(), progress or Progress()
        return adaptive_voxels.adaptive(
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
        work.begin([_absolute(opened.path), len(opened), __version__], resolved)
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
    encoder: Encoder = _load_backend(settings, "language", "encoder", capture)

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
    _check_result(trajectory, progress, work)
    if not mapper.tracker.metric:
        work.warnings.append(scaling.UNKNOWN)
        progress.warn(scaling.UNKNOWN)
    progress.stage("saving")
    _save(work, mapper, trajectory, gaussians, features, occupancy, encoder, vocabulary)
    work.finish(output)
    return load_map(output)


def _vocabulary(mapper: Mapper, work: WorkFolder, progress: Progress) -> dict[str, Any] | None:
    """Names of what the mapped keyframes show, as the map keeps them; None if no model is to be asked."""
    options: scene_vocabulary.Options = _options(scene_vocabulary, mapper.settings["vocabulary"])
    namer = scene_vocabulary.load(options)
    if namer is None:
        return None
    frames = mapper.trajectory().keyframes
    chosen = mapper.keyframes.only(frames[_evenly(len(frames), options.keyframes)])
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
    frames = used_frames(capture)
    if mapper.tracker.offline:
        mapper.tracker.prepare(work.begin_offline(), frames, progress)
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
    opened = open_capture(capture, _options(capture_base, config.options(settings, "capture")), section)
    used_frames(opened)
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
        ratio = focal_calibration.color_focal(capture, used_frames(capture))
        if ratio != 1:
            text = (
                f"Colour and depth of {capture.path} fit each other only if the colour camera's focal length is "
                f"{ratio:.3f} of what its files say: colour is resampled so (capture.color_focal=1 leaves it as it is)."
            )
            work.warnings.append(text)
            progress.warn(text)
    return capture if ratio == 1 else Reregistered(capture, ratio)


def _check_result(trajectory: Trajectory, progress: Progress, work: WorkFolder) -> None:
    """Warn about a run whose map shows only part of the scan."""
    if work.broken:
        count = len(work.broken)
        text = f"{count} frame{'s' if count > 1 else ''} could not be read and were skipped; report.json says why."
        work.warnings.append(text)
        progress.warn(text)
    used = trajectory.status != "unused"
    lost = int(np.count_nonzero(trajectory.status == "lost"))
    if lost:
        share = lost / max(int(np.count_nonzero(used)), 1)
        first = int(np.flatnonzero(trajectory.status == "lost")[0])
        frames = f"{lost} frame{'s' if lost > 1 else ''} ({share:.0%})"
        text = f"Tracking lost {frames}, the first is frame {first}: what only these show is not in the map."
        if share > _FEW_TRACKED:
            text += " Most of the scan is missing: was it captured slowly, with depth in most of each image?"
        work.warnings.append(text)
        progress.warn(text)
    apart = np.flatnonzero(trajectory.status == "apart")
    if len(apart):
        share = len(apart) / max(int(np.count_nonzero(used)), 1)
        text = (
            f"{len(apart)} frames ({share:.0%}), the first is frame {apart[0]}, were tracked, but nothing ties them to "
            "the rest: they are submaps of their own and not in the map, which is of the largest."
        )
        work.warnings.append(text)
        progress.warn(text)


def _save(
    work: WorkFolder,
    mapper: Mapper,
    trajectory: Trajectory,
    gaussians: Gaussians,
    features: NDArray[np.float16],
    occupancy: Occupancy,
    encoder: Encoder,
    vocabulary: dict[str, Any] | None,
) -> None:
    capture, keyframes = mapper.capture, mapper.mapped(trajectory)
    submaps = mapper.tracker.submaps()
    folder = work.folder
    with work.timed("saving"):
        codec = Codec.fit(features)
        store.write_occupancy(folder, occupancy, codec, features)
        write_tum(folder / store.TRAJECTORY, trajectory)
        settings = mapper.settings
        if not mapper.tracker.metric:  # says how fine its Gaussians are when the map is put on other lattices
            settings = {**settings, "gaussians": {**settings["gaussians"], "cell_size": mapper.cell_size}}
        (folder / store.CONFIG).write_text(config.dump(settings), encoding="utf-8")
        metric = mapper.tracker.metric
        manifest = _manifest(mapper, trajectory, gaussians, occupancy, encoder, submaps)
        up = np.array(manifest["up"])
        trajectory_picture.path_picture(
            folder / store.PATH_PICTURE, submaps, trajectory, gaussians, up, capture.path, metric
        )
        views = list(zip(trajectory.keyframes.tolist(), mapper.views(trajectory), strict=True))
        shown = [views[row] for row in _evenly(len(views), render_pictures.SHOWN)]
        picture = folder / store.RENDER_PICTURE
        render_pictures.render_picture(picture, gaussians, shown, mapper.rasterizer, capture.path, metric)
        measured = [views[row][1] for row in _evenly(len(views), _MEASURED_VIEWS)]
        fidelity = rendered_views.fidelity(gaussians, measured, mapper.rasterizer)
        if len(keyframes) < len(mapper.keyframes):
            work.forget_tracking()  # it counts those that are left out from here on
        keyframes.save_index()
        keyframes.drop_unlisted()
    report = {**_report(work, capture, trajectory, submaps), "rendering": dataclasses.asdict(fidelity)}
    (folder / store.REPORT).write_text(json.dumps(report), encoding="utf-8")
    store.write_manifest(folder, {**manifest, **({"vocabulary": vocabulary} if vocabulary else {})})


def _manifest(
    mapper: Mapper,
    trajectory: Trajectory,
    gaussians: Gaussians,
    occupancy: Occupancy,
    encoder: Encoder,
    submaps: list[Submap],
) -> dict[str, Any]:
    capture = mapper.capture
    turned = np.array([capture.turned(index) for index in trajectory.keyframes.tolist()], np.int8)
    held = turned_back(trajectory.T_world_keyframe, turned)
    return {
        "freeocc3d": __version__,
        "capture": {"path": _absolute(capture.path), "format": capture.format, "frames": len(capture)},
        "frame": mapper.tracker.world,
        "poses": "camera to world",
        **store.sizes(occupancy),
        "origin": occupancy.origin.tolist(),
        "scale": _scale(mapper),
        "up": estimate_up(held, gaussians.means).tolist(),
        "T_world_map": np.eye(4).tolist(),
        "T_gravity_map": gravity_frame(held, gaussians).tolist(),
        "encoder": {"name": encoder.name, "dimension": encoder.dimension, "state": encoder.text_state()},
        "codec": "transform coding, 8, 4 and 2 bits a direction",
        "counts": {
            "gaussians": len(gaussians),
            "voxels": store.counts(occupancy),
            "frames": len(trajectory),
            "frames_with_pose": int(trajectory.has_pose.sum()),
            "submaps": len(submaps),
        },
        "keyframes": trajectory.keyframes.tolist(),
    }


def _scale(mapper: Mapper) -> dict[str, Any]:
    """Whether lengths are metres, what says so, and how many a unit of what the tracker gives is."""
    capture, given = mapper.capture, mapper.capture.options.scale
    if not mapper.tracker.metric:
        return {"metric": False, "by": "none", "factor": 1.0}
    by = "sensor" if capture.has_depth else "given" if given is not None else "poses"
    return {"metric": True, "by": by, "factor": given or 1.0}


def _report(work: WorkFolder, capture: Capture, trajectory: Trajectory, submaps: list[Submap]) -> dict[str, Any]:
    status, count = np.unique(trajectory.status, return_counts=True)
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "seconds": {name: round(value, 3) for name, value in work.seconds.items()},
        "peak_memory_bytes": peak_kib * 1024,
        "frames": {str(s): int(n) for s, n in zip(status, count, strict=True)},
        "broken": {str(index): text for index, text in work.broken.items()},
        "warnings": work.warnings,
        "color_focal": getattr(capture, "color_focal", 1.0),
        "submaps": [
            {
                "frames": len(submap.frames),
                "first": int(submap.frames[0]),
                "last": int(submap.frames[-1]),
                "keyframes": len(submap.keyframes),
                "mapped": number == 0,
                "closures": [
                    [*ends, held] for ends, held in zip(submap.closures.tolist(), submap.held.tolist(), strict=True)
                ],
            }
            for number, submap in enumerate(submaps)
        ],
        "bytes_per_gaussian": 67,
        "frame_log": {
            "timestamp": trajectory.timestamps.tolist(),
            "status": trajectory.status.tolist(),
            "confidence": np.round(trajectory.confidence.astype(np.float64), 3).tolist(),
        },
    }


def _load_backend(settings: Config, section: str, key: str, *arguments: Any) -> Any:
    """The backend that ``settings[section][key]`` names, made with its own options and what else its kind takes."""
    name = settings[section][key]
    folder = config.SECTIONS[section][1]
    assert folder is not None
    module = registry.load(folder, name)
    if not hasattr(module, "Options"):
        return module.load(*arguments)
    return module.load(registry.build_options(module, settings[section].get(name, {})), *arguments)


def check(settings: Config) -> None:
    """Build the options of every layer and of the chosen backends, so that a value out of range is told before any
    work. A backend that needs more than packages has a function ``check``. Raises ConfigError, DependencyError for a
    backend whose packages are not installed, or what ``check`` raises."""
    layers = {"gaussians": anchors, "fitting": fitting, "language": lifting, "occupancy": splat, "carving": carve}
    for section, module in layers.items():
        _options(module, config.options(settings, section))
    if settings["occupancy"]["finest"] is not None:
        adaptive_voxels.halvings(settings["occupancy"]["voxel_size"], settings["occupancy"]["finest"])
    scene_vocabulary.load(_options(scene_vocabulary, settings["vocabulary"]))
    _options(multi_view_stereo, settings["tracking"]["stereo"])
    for section, key in (("tracking", "backend"), ("fitting", "rasterizer"), ("language", "encoder")):
        name = settings[section][key]
        backend = registry.load(str(config.SECTIONS[section][1]), name)
        if hasattr(backend, "Options"):
            options = _options(backend, settings[section].get(name, {}))
            if hasattr(backend, "check"):
                backend.check(options)


def _options(module: Any, values: dict[str, Any]) -> Any:
    return registry.build_options(module, values)


def _evenly(count: int, wanted: int) -> list[int]:
    """At most ``wanted`` of ``count`` rows, evenly spread, none at the very ends if there are enough."""
    return [int((n + 0.5) * count / min(wanted, count)) for n in range(min(wanted, count))]


def _absolute(path: Path) -> str:
    return str(path) if str(path).startswith("builtin:") else str(path.resolve())
