"""Structure from motion of a capture.

The stages choose frames (``frame_selection``), find features (``local_features``), propose pairs of images
(``pair_selection``), match and verify them (``feature_matching``, ``database``), map and adjust (``mapping``). Each
stage saves its result in a folder and does not run again.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...capture.base import Capture
from ...core.atomic_files import replace_text
from ...core.checksums import seal, unseal
from ...core.errors import FrameError, MapError
from ...core.progress import Progress
from ...core.regular_files import TEXT_BYTES, read_bytes
from ...core.threads import count_threads
from ...core.types import Intrinsics
from ...core.warnings import Notice
from . import diagnosis, frame_selection, mapping, pair_selection
from .colmap_reconstruction import convert_model, plain_model
from .database import SfmDatabase, image_name
from .feature_matching import match_descriptors
from .local_features import Detector, LocalFeatures, load_detector
from .reconstruction import Reconstruction

_DATABASE, _CHOSEN, _RESULT = "database.db", "chosen.json", "reconstruction.npz"

_ALL_PAIRS = 60
"""Largest number of unordered images with all pairs compared; with more images, only similar ones are compared."""

_FOLLOW, _ALIKE, _ALIKE_UNORDERED = 5, 8, 24
_CHUNK = 64
_CACHED = 128


@dataclass(frozen=True)
class Recipe:
    """How to reconstruct a capture; see ``trackers.colmap.Options`` for the fields."""

    frames: int = 300
    order: str = "auto"
    features: str = "sift"
    mapping: str = "incremental"
    intrinsics: str = "refine"


def reconstruct_poses(
    capture: Capture, frames: Sequence[int], folder: Path, recipe: Recipe, progress: Progress
) -> Reconstruction:
    """Poses and points of the capture's frames, scaled to a median depth of ``NOMINAL_DEPTH``.

    folder: keeps what an interrupted call needs to continue. Raises TrackingError if the scan gives no poses, and
    ModelError.
    """
    if (folder / _RESULT).is_file():
        with contextlib.suppress(MapError):  # damaged: made again
            return Reconstruction.load(folder / _RESULT)
    what = str(capture.path)
    diagnosis.check_count(len(frames), what)
    chosen = _chosen(capture, frames, folder / _CHOSEN, recipe.frames, progress)
    detect = load_detector(recipe.features)
    mapping.silence_colmap()
    with SfmDatabase(folder / _DATABASE) as database:
        warnings = _extract(capture, chosen, database, detect, recipe, progress)
        found = database.frames()
        diagnosis.check_count(len(found), what)
        diagnosis.check_features([len(database.pixels(frame)) for frame in found], what)
        _compare(database, found, recipe.order, detect.ratio, progress)
        diagnosis.check_motion(database, what)
        models = _mapped(folder, len(found), recipe, progress)
        largest = models[0].num_reg_images() if models else 0
        if largest < diagnosis.LEAST_IMAGES:
            raise diagnosis.explain_missing_model(database, largest, what)
    progress.stage("adjustment")
    model = mapping.adjust_model(models[0], recipe.intrinsics == "fixed", distorts=not capture.intrinsics_known)
    frame_of = {image_name(index): index for index in found}
    result = convert_model(plain_model(model), len(capture), frame_of.get, what).normalized()
    apart, pieces = _apart(models, result.has_pose)
    if pieces:
        text = (
            f"{what} gave {pieces + 1} models that are not connected: only the largest, of {largest} images, is "
            "mapped. Film the way between them, or reconstruct them one by one (capture.start, capture.stop)."
        )
        warnings.append(Notice("models-apart", text))
    result = replace(
        result,
        apart=apart,
        chosen=np.isin(np.arange(len(capture)), chosen),
        warnings=tuple(warnings),
    )
    result.save(folder / _RESULT)
    return result


def _apart(models: Sequence[pycolmap.Reconstruction], has_pose: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], int]:
    """(N,) frames that are only in other models than the first, and the number of such models. A model counts if it has
    more than a few frames of its own."""
    apart, pieces = np.zeros(len(has_pose), bool), 0
    for model in models[1:]:
        own = np.array(model.reg_image_ids(), np.int64) - 1
        own = own[~has_pose[own] & ~apart[own]]
        if len(own) >= diagnosis.LEAST_IMAGES:
            apart[own] = True
            pieces += 1
    return apart, pieces


def _chosen(capture: Capture, frames: Sequence[int], path: Path, budget: int, progress: Progress) -> list[int]:
    """The frames to reconstruct; the choice is saved at ``path``."""
    with contextlib.suppress(OSError, ValueError):  # there is none, or it is damaged
        return list(json.loads(unseal(read_bytes(path, TEXT_BYTES))))
    found = frame_selection.choose_frames(capture, frames, budget, progress)
    replace_text(path, seal(json.dumps(found)))
    return found


def _extract(
    capture: Capture,
    chosen: Sequence[int],
    database: SfmDatabase,
    detect: Detector,
    recipe: Recipe,
    progress: Progress,
) -> list[Notice]:
    """Store the features of the chosen frames in the database. Leaves out frames that do not decode or differ in size
    from the first. Returns warnings."""
    progress.stage("features", len(chosen))
    there = set(database.frames())
    waiting = [index for index in chosen if index not in there]
    others = 0

    def seen(index: int) -> tuple[Intrinsics, LocalFeatures] | None:
        try:
            frame = capture[index]
        except FrameError:
            return None
        return frame.intrinsics, detect(frame.color)

    with ThreadPoolExecutor(count_threads()) as pool:
        for start in range(0, len(waiting), _CHUNK):
            part = waiting[start : start + _CHUNK]
            done = len(chosen) - len(waiting) + start
            for index, found in zip(part, pool.map(seen, part), strict=True):
                if found is not None:
                    camera, features = found
                    database.set_camera(_model(capture, recipe), camera, capture.intrinsics_known)
                    if (camera.width, camera.height) == database.size():
                        database.add(index, features)
                    else:
                        others += 1
                done += 1
                progress.advance(done)
    if not others:
        return []
    text = f"{others} images of {capture.path} have another size than the first and are left out."
    return [Notice("images-left-out", text)]


def _model(capture: Capture, recipe: Recipe) -> str:
    """COLMAP's name of the camera model for matching and mapping."""
    if recipe.intrinsics == "fixed":
        return "PINHOLE"
    return "SIMPLE_PINHOLE" if capture.intrinsics_known else "SIMPLE_RADIAL"


def _compare(database: SfmDatabase, frames: Sequence[int], order: str, ratio: float, progress: Progress) -> None:
    """Match pairs of images that may overlap, and verify the matches by geometry."""
    descriptors = functools.lru_cache(_CACHED)(database.descriptors)
    proposed = [(frames[i], frames[j]) for i, j in _pairs(descriptors, frames, order).tolist()]
    verified = database.verified()
    waiting = [pair for pair in proposed if pair not in verified]
    progress.stage("matching", len(proposed))
    with ThreadPoolExecutor(count_threads()) as pool:
        for start in range(0, len(waiting), _CHUNK):
            part = waiting[start : start + _CHUNK]
            described = [(descriptors(i), descriptors(j)) for i, j in part]
            database.add_matches(
                part, list(pool.map(lambda pair: match_descriptors(pair[0], pair[1], ratio), described))
            )
            progress.advance(len(proposed) - len(waiting) + start + len(part))


def _pairs(descriptors: Callable[[int], NDArray[np.float32]], frames: Sequence[int], order: str) -> NDArray[np.int64]:
    """(P, 2) pairs of rows of ``frames`` to compare."""
    rng = np.random.default_rng(0)
    sampled = []
    for frame in frames:
        found = descriptors(frame)
        sampled.append(found[rng.permutation(len(found))[: pair_selection.OF_IMAGE]])
    alike = pair_selection.compare_images(sampled)
    if order == "video" or (order == "auto" and pair_selection.is_sequence(alike)):
        return pair_selection.choose_pairs(alike, _FOLLOW, _ALIKE)
    return pair_selection.choose_pairs(alike, 0, len(frames) - 1 if len(frames) <= _ALL_PAIRS else _ALIKE_UNORDERED)


def _mapped(folder: Path, images: int, recipe: Recipe, progress: Progress) -> list[pycolmap.Reconstruction]:
    """Models, the largest first. Images without a pose get a second try when the model is complete."""
    fixed = recipe.intrinsics == "fixed"
    progress.stage("mapping", images)
    placed = itertools.count(1)

    def advance() -> None:
        progress.advance(min(next(placed), images))

    if recipe.mapping == "global":
        models = mapping.map_globally(folder / _DATABASE, folder, fixed)
    else:
        models = mapping.map_incrementally(folder / _DATABASE, folder, fixed, advance)
    somewhere = {image_id for model in models for image_id in model.reg_image_ids()}
    if models and len(somewhere) < images:
        models[0] = mapping.continue_mapping(folder / _DATABASE, folder, fixed, models[0])
    return models
