"""Predicts the voxels of a truth's lattice: from a map, from Gaussians of any origin, or from a finished grid.

Gaussians are moved into the true frame (paper, "Coordinate System Alignment") and projected at the truth's own voxel
centers. Only a finished grid is resampled.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..capture import associate
from ..core.errors import FreeOccError
from ..core.transforms import invert, is_rigid
from ..core.types import BLOCK, OCCUPIED, UNKNOWN, Gaussians, PosedFrame
from ..core.voxel_keys import unpack_voxels
from ..gaussians import anchors
from ..gaussians.splat_ply import read_standard_ply
from ..language.encoders.base import TextEncoder, TextFeatures
from ..occupancy import build, splat
from ..occupancy.confirmed_depth import hide_unconfirmed
from ..query import word_query
from ..query.scan_map import Map
from ..settings.config import Settings
from ..tracking.trajectory_alignment import Poses, TrajectoryAlignment
from .confusion import Prediction
from .ground_truth import read_grid_arrays, read_lattice, require_array
from .scored_classes import ClassMap
from .true_occupancy import GroundTruth

_MOST_CLASSES = 1 << 16

_SAME_SIZE, _SAME_LATTICE = 1e-4, 1e-3


def predict_from_map(
    scan_map: Map, settings: Settings, alignment: TrajectoryAlignment, truth: GroundTruth, classes: ClassMap
) -> tuple[Prediction, str]:
    """Returns a map's prediction, and a sentence about its classes, or an empty string.

    settings: the map's configuration; the sections of layer 4 apply, at the truth's voxel size. The map's keyframes
    carve free space again on the truth's lattice. A voxel takes the class of its nearest word (paper, s(x, c) =
    f(x)^T t_c).
    """
    splatting = _splatting(settings, truth)
    gaussians = anchors.align_gaussians(scan_map.gaussians, alignment.scale, alignment.rotation, alignment.translation)
    text, targets, note = _words(scan_map.text_encoder, classes, truth)
    features = scan_map.gaussian_features if text is not None else np.zeros((len(gaussians), 0), np.float16)
    own, scale = settings.occupancy.voxel_size, alignment.scale
    cell_size = settings.gaussians.cell_size or 0.5 * own
    occupancy = build.build_occupancy(
        gaussians,
        features,
        hide_unconfirmed(_scaled(scan_map, alignment), gaussians, scale * own, scale * cell_size),
        splatting,
        settings.carving,
        origin=truth.origin,
        least_scale=_least_scale(settings, alignment, truth),
    )
    voxels = occupancy.voxels(OCCUPIED)
    inside = ((voxels >= 0) & (voxels < truth.shape)).all(axis=1)
    at = tuple(voxels[inside].T)
    occupied = np.zeros(truth.shape, bool)
    occupied[at] = True
    if text is None:
        return Prediction(occupied), note
    labels = np.zeros(truth.shape, np.uint8)
    labels[at] = targets[word_query.nearest_word(occupancy.features[inside], text)]
    return Prediction(occupied, labels), note


def predict_from_gaussians(
    gaussians: Gaussians,
    semantics: NDArray[np.floating] | None,
    settings: Settings,
    alignment: TrajectoryAlignment,
    truth: GroundTruth,
) -> Prediction:
    """Returns the prediction of N Gaussians without keyframes: occupied where alpha reaches the threshold, without
    carving.

    semantics: (N, C) weight of each class 1 … C; a voxel takes the class with the largest posterior mean.
    """
    splatting = _splatting(settings, truth)
    moved = anchors.align_gaussians(gaussians, alignment.scale, alignment.rotation, alignment.translation)
    bins = splat.bin_gaussians(moved, truth.origin, splatting, truth.shape)
    keys = unpack_voxels(bins.packed)
    probability = splat.compute_probability(bins, keys)
    block, local = np.nonzero(probability >= splatting.threshold)
    voxels = keys[block] * BLOCK + np.stack((local // 64, local // 8 % 8, local % 8), axis=1)
    occupied = np.zeros(truth.shape, bool)
    occupied[tuple(voxels.T)] = True
    if semantics is None:
        return Prediction(occupied)
    slots = np.full(probability.shape, -1, np.int32)
    slots[block, local] = np.arange(len(block))
    mean = splat.compute_posterior_mean(bins, keys, slots, semantics)
    labels = np.zeros(truth.shape, np.uint8)
    labels[tuple(voxels.T)] = np.where(mean.any(axis=1), mean.argmax(axis=1) + 1, 0)
    return Prediction(occupied, labels)


def predict_from_frames(
    folder: Path, poses: Poses, settings: Settings, truth: GroundTruth, classes: ClassMap
) -> tuple[Prediction, int]:
    """Returns the prediction of per-frame Gaussians, fused by true poses, and the number of fused frames. This is the
    paper's protocol for methods that predict each frame separately (GaussTR, GaussianOcc).

    folder: holds a file per frame, in the camera's frame (OpenCV axes, meters). The last number in its name is the
    frame's timestamp. A file is a 3DGS PLY, or an NPZ with means (N, 3), scales (N, 3), quats_wxyz (N, 4), opacities
    (N,) and, optionally, semantics (N, C) over the scored classes or labels (N,) that count them from 1.
    Raises FreeOccError: no such files, no file with a pose, a damaged file.
    """
    paths = [p for p in folder.glob("*") if p.suffix in (".ply", ".npz")] if folder.is_dir() else []
    numbered = {float(numbers[-1]): p for p in paths if (numbers := re.findall(r"\d+(?:\.\d+)?", p.stem))}
    if not numbered:
        raise FreeOccError(
            f"{folder} has no per-frame Gaussians: .ply or .npz files with the frame's number in the name."
        )
    times = np.array(sorted(numbered))
    rows, rows_true = associate(times, poses.timestamps)
    if not len(rows):
        raise FreeOccError(f"No file in {folder} has the number of a frame with a true pose.")
    parts, semantics = [], []
    for time, T_world_cam in zip(times[rows], poses.T_world_cam[rows_true], strict=True):
        read = _read_frame if numbered[time].suffix == ".npz" else _read_labeled
        gaussians, weights = read(numbered[time], classes)
        parts.append(anchors.align_gaussians(gaussians, 1.0, T_world_cam[:3, :3], T_world_cam[:3, 3]))
        semantics.append(weights)
    fused = Gaussians(*(np.concatenate([getattr(p, name) for p in parts]) for name in Gaussians.__dataclass_fields__))
    known = [weights for weights in semantics if weights is not None]
    if known and len(known) < len(semantics):
        raise FreeOccError(f"Some files in {folder} hold classes and some do not: give classes in all or in none.")
    fused_semantics = np.concatenate(known) if known else None
    return predict_from_gaussians(fused, fused_semantics, settings, TrajectoryAlignment.identity(), truth), len(rows)


def predict_from_grid(
    path: Path, alignment: TrajectoryAlignment, truth: GroundTruth, classes: ClassMap, with_trajectory: bool = False
) -> tuple[Prediction, str]:
    """Returns the prediction of a finished voxel grid at the truth's voxel centers, and a sentence if the lattices
    differ.

    path: an NPZ of ``export --format npz``, or of a ground truth.  with_trajectory: whether the alignment is that of
    the trajectory that the grid was made with. Raises FreeOccError: damaged, another voxel size.
    """
    arrays = read_grid_arrays(path)
    origin, size = read_lattice(arrays, path)
    if abs(size * alignment.scale / truth.voxel_size - 1) > _SAME_SIZE:
        raise FreeOccError(
            f"{path} has voxels of {size:g} m, the ground truth of {truth.voxel_size:g} m: make both with one voxel "
            "size, because a finished grid cannot be scored on another lattice."
        )
    labels = require_array(arrays, "labels", path) if "occupancy" not in arrays else arrays.get("labels")
    grid = arrays.get("occupancy", labels)
    if (
        grid is None
        or grid.ndim != 3
        or grid.dtype.kind not in "ui"
        or (labels is not None and labels.shape != grid.shape)
    ):
        raise FreeOccError(f"{path} must hold 'occupancy' or 'labels', whole numbers (X, Y, Z).")
    points = alignment.to_estimate(truth.centers())
    T = _placed_grid(arrays, with_trajectory, path)
    inside_grid = ((points - T[:3, 3]) @ T[:3, :3] - origin) / size
    index = np.floor(inside_grid).astype(np.int64)
    inside = ((index >= 0) & (index < grid.shape)).all(axis=-1)
    at = tuple(index[inside].T)
    occupied = np.zeros(truth.shape, bool)
    occupied[inside] = (grid[at] != 0) & (grid[at] != UNKNOWN)
    off = float(np.abs(inside_grid - index - 0.5).max())
    note = ""
    if off > _SAME_LATTICE:
        note = (
            f"{path.name} lies on another lattice (centers up to {off:.2f} voxels apart): each voxel takes the state "
            "of the grid's voxel that holds its center."
        )
    if labels is None or "classes" not in arrays:
        return Prediction(occupied), note
    if arrays["classes"].dtype.kind != "U" or arrays["classes"].ndim != 1:
        raise FreeOccError(f"'classes' of {path} must be a list of names, got {arrays['classes'].dtype}.")
    if labels.dtype.kind not in "ui" or labels.min(initial=0) < 0 or labels.max(initial=0) >= _MOST_CLASSES:
        raise FreeOccError(f"'labels' of {path} must be whole numbers from 0 to {_MOST_CLASSES - 1}.")
    names = [str(name).lower() for name in arrays["classes"].tolist()[:_MOST_CLASSES]]
    # Class names begin at label 1 in an export, at label 0 in a ground truth.
    names = names[1:] if "occupancy" not in arrays else names
    table = np.zeros(_MOST_CLASSES + 1, np.uint8)
    table[1 : len(names) + 1] = [classes.labels.get(name, 0) for name in names]
    if not table.any():
        return Prediction(occupied), note
    predicted = np.zeros(truth.shape, np.uint8)
    predicted[inside] = table[labels[at]]
    return Prediction(occupied, np.where(occupied, predicted, 0).astype(np.uint8)), note


def _placed_grid(arrays: Mapping[str, NDArray[np.generic]], with_trajectory: bool, path: Path) -> NDArray[np.float64]:
    """Returns the (4, 4) transform from a grid's frame to that of its trajectory, which is the map's for the grid of a
    map, or to the world of given poses. Raises FreeOccError."""
    for name in ("T_world_map", "T_frame_map"):
        T = arrays.get(name, np.eye(4))
        if T.dtype.kind != "f" or not is_rigid(T.astype(np.float64)):
            raise FreeOccError(f"'{name}' of {path} is not a rigid transform.")
    if with_trajectory and "T_frame_map" in arrays:
        return np.asarray(invert(arrays["T_frame_map"].astype(np.float64)))
    return np.asarray(arrays.get("T_world_map", np.eye(4)), np.float64)


def _scaled(scan_map: Map, alignment: TrajectoryAlignment) -> Iterator[PosedFrame]:
    """Yields keyframes in the true frame, with depth in its meters. A similarity also scales the cameras' frames."""
    poses = alignment.poses(scan_map.trajectory.T_world_keyframe)
    for row, (frame, T) in enumerate(zip(scan_map.keyframes, poses, strict=True)):
        yield PosedFrame(frame.scaled(alignment.scale), T, row)


def _splatting(settings: Settings, truth: GroundTruth) -> splat.Options:
    """Returns layer 4's options at the truth's voxel size, on the CPU even for a map made on a GPU."""
    return settings.occupancy.changed(device="cpu", voxel_size=truth.voxel_size)


def _least_scale(settings: Settings, alignment: TrajectoryAlignment, truth: GroundTruth) -> float:
    """Returns the scale that the map's Gaussians are widened to on the truth's lattice, meters."""
    cell_size = settings.gaussians.cell_size or 0.5 * settings.occupancy.voxel_size
    return anchors.compute_least_scale(settings.gaussians, alignment.scale * cell_size, truth.voxel_size)


def _words(
    encoder: TextEncoder, classes: ClassMap, truth: GroundTruth
) -> tuple[TextFeatures | None, NDArray[np.uint8], str]:
    """Returns the words for scored classes that the encoder understands, the class of each (with a last entry for
    "nothing known"), and a sentence about the truth's classes that it does not understand. Without words: (None, …)."""
    words = list(classes.words)
    text = encoder.encode_words(words)
    rows = np.flatnonzero(text.features.any(axis=1))
    reached = {classes.labels[words[row]] for row in rows}
    lacking = [classes.classes[k - 1] for k in np.unique(truth.labels) if 0 < k < UNKNOWN and k not in reached]
    note = ""
    if not len(rows):
        note = f"The map's encoder knows none of the classes, only {encoder.knows}: mIoU is not available."
    elif lacking:
        note = f"The map's encoder cannot name {', '.join(lacking)}, which the truth holds: they count as missed."
    chosen = TextFeatures(text.features[rows], tuple(text.understood[row] for row in rows)) if len(rows) else None
    return chosen, np.array([*(classes.labels[words[row]] for row in rows), 0], np.uint8), note


def encode_one_hot(labels: NDArray[np.integer] | None, classes: ClassMap, path: Path) -> NDArray[np.float32] | None:
    """Returns (N, C) weights from (N,) labels 1 … C; 0 and 255 mean no class. Raises FreeOccError for other labels."""
    if labels is None:
        return None
    count = len(classes.classes)
    unknown = (labels != UNKNOWN) & ((labels < 0) | (labels > count))
    if unknown.any():
        raise FreeOccError(f"{path} has label {labels[unknown][0]}, but {count} classes are scored.")
    one_hot = np.zeros((len(labels), count + 1), np.float32)
    one_hot[np.arange(len(labels)), np.where(labels == UNKNOWN, 0, labels)] = 1
    return one_hot[:, 1:]


def _read_labeled(path: Path, classes: ClassMap) -> tuple[Gaussians, NDArray[np.float32] | None]:
    gaussians, labels = read_standard_ply(path)
    return gaussians, encode_one_hot(labels, classes, path)


def _read_frame(path: Path, classes: ClassMap) -> tuple[Gaussians, NDArray[np.float32] | None]:
    arrays = read_grid_arrays(path)
    means = require_array(arrays, "means", path)
    n = len(means)
    shapes = {"means": (n, 3), "scales": (n, 3), "quats_wxyz": (n, 4), "opacities": (n,)}
    for name, shape in shapes.items():
        values = require_array(arrays, name, path)
        if values.shape != shape or values.dtype.kind != "f" or not np.isfinite(values).all():
            raise FreeOccError(f"'{name}' of {path} must be finite numbers of shape {shape}, got {values.shape}.")
    fields = {name: arrays[name].astype(np.float32) for name in shapes}
    opacities, lengths = fields["opacities"], np.linalg.norm(fields["quats_wxyz"].astype(np.float64), axis=1)
    sound = (fields["scales"] > 0).all() and (lengths > 0).all() and ((opacities >= 0) & (opacities <= 1)).all()
    if not sound or not np.isfinite(fields["means"]).all() or not np.isfinite(fields["scales"]).all():
        raise FreeOccError(
            f"{path} holds Gaussians that cannot be: scales must be positive, opacities 0 to 1, rotations not zero."
        )
    gaussians = Gaussians(
        **fields,
        colors=np.full((n, 3), 128, np.uint8),
        anchor_keyframe=np.full(n, -1, np.int32),
        anchor_cam=fields["means"],
    )
    if (labels := arrays.get("labels")) is not None:
        if labels.dtype.kind not in "ui" or labels.shape != (n,):
            raise FreeOccError(f"'labels' of {path} must be {n} whole numbers, got {labels.dtype} {labels.shape}.")
        return gaussians, encode_one_hot(labels.astype(np.int64), classes, path)
    semantics = arrays.get("semantics")
    if semantics is not None and (semantics.dtype.kind != "f" or not np.isfinite(semantics).all()):
        raise FreeOccError(f"'semantics' of {path} must be finite numbers, got {semantics.dtype}.")
    if semantics is not None and semantics.shape != (n, len(classes.classes)):
        raise FreeOccError(f"'semantics' of {path} must be {(n, len(classes.classes))}, got {semantics.shape}.")
    return gaussians, None if semantics is None else semantics.astype(np.float32)
