"""What is claimed about the voxels of a truth's lattice: by a map, by Gaussians of any origin, by a finished grid.

Gaussians are moved into the true frame (paper, "Coordinate System Alignment") and projected at the truth's own voxel
centers: nothing is resampled from a finished grid, unless a finished grid is all that there is.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..capture import associate
from ..core.errors import FreeOccError
from ..core.types import BLOCK, OCCUPIED, UNKNOWN, Gaussians, PosedFrame
from ..core.voxel_keys import unpack_voxels
from ..gaussians import anchors
from ..gaussians.splat_ply import read_standard_ply
from ..language.encoders.base import TextEncoder, TextFeatures
from ..occupancy import build, splat
from ..query import word_query
from ..query.scan_map import Map
from ..settings.config import Settings
from ..tracking.trajectory_alignment import Poses, TrajectoryAlignment
from .confusion import Prediction
from .ground_truth import read_grid_arrays, read_lattice, require_array
from .scored_classes import ClassMap
from .true_occupancy import GroundTruth

_SAME_SIZE, _SAME_LATTICE = 1e-4, 1e-3


def predict_from_map(
    scan_map: Map, settings: Settings, alignment: TrajectoryAlignment, truth: GroundTruth, classes: ClassMap
) -> tuple[Prediction, str]:
    """A map's claim, and one sentence about its classes if there is something to say.

    settings: the map's configuration, of which layer 4's sections are used, at the truth's voxel size. Free space is
    carved again on the truth's lattice from the map's keyframes. A voxel takes the class that its nearest word stands
    for (paper, s(x, c) = f(x)^T t_c).
    """
    splatting = _splatting(settings, truth)
    gaussians = anchors.align_gaussians(scan_map.gaussians, alignment.scale, alignment.rotation, alignment.translation)
    text, targets, note = _words(scan_map.text_encoder, classes, truth)
    features = scan_map.gaussian_features if text is not None else np.zeros((len(gaussians), 0), np.float16)
    occupancy = build.build_occupancy(
        gaussians,
        features,
        _scaled(scan_map, alignment),
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
    """The claim of N Gaussians without keyframes: occupied where alpha reaches the threshold, nothing carved.

    semantics: (N, C) weight of each class 1 … C; a voxel takes the class of the largest posterior mean.
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
    """The claim of per-frame Gaussians fused by true poses, and the number of frames fused: the paper's protocol for
    methods that predict each frame by itself (GaussTR, GaussianOcc).

    folder: a file per frame in the camera's frame (OpenCV axes, meters), the last number in its name being the frame's
    timestamp: a 3DGS PLY, or an NPZ with means (N, 3), scales (N, 3), quats_wxyz (N, 4), opacities (N,) and perhaps
    semantics (N, C) over the scored classes or labels (N,), which count them from 1.
    Raises FreeOccError: no such files, none has a pose, a file is damaged.
    """
    paths = [p for p in folder.glob("*") if p.suffix in (".ply", ".npz")] if folder.is_dir() else []
    numbered = {float(numbers[-1]): p for p in paths if (numbers := re.findall(r"\d+(?:\.\d+)?", p.stem))}
    if not numbered:
        raise FreeOccError(f"There are no per-frame Gaussians (.ply or .npz with the frame's number) in {folder}.")
    times = np.array(sorted(numbered))
    rows, rows_true = associate(times, poses.timestamps)
    if not len(rows):
        raise FreeOccError(f"No file of {folder} has the number of a frame with a true pose.")
    parts, semantics = [], []
    for time, T_world_cam in zip(times[rows], poses.T_world_cam[rows_true], strict=True):
        read = _read_frame if numbered[time].suffix == ".npz" else _read_labeled
        gaussians, weights = read(numbered[time], classes)
        parts.append(anchors.align_gaussians(gaussians, 1.0, T_world_cam[:3, :3], T_world_cam[:3, 3]))
        semantics.append(weights)
    fused = Gaussians(*(np.concatenate([getattr(p, name) for p in parts]) for name in Gaussians.__dataclass_fields__))
    known = [weights for weights in semantics if weights is not None]
    if known and len(known) < len(semantics):
        raise FreeOccError(f"Some files of {folder} hold classes and some do not: give all or none.")
    fused_semantics = np.concatenate(known) if known else None
    return predict_from_gaussians(fused, fused_semantics, settings, TrajectoryAlignment.identity(), truth), len(rows)


def predict_from_grid(
    path: Path, alignment: TrajectoryAlignment, truth: GroundTruth, classes: ClassMap
) -> tuple[Prediction, str]:
    """The claim of a finished voxel grid, read at the truth's voxel centers, and one sentence if the lattices differ.

    path: NPZ as ``export --format npz`` or a ground truth writes it. Raises FreeOccError: damaged, another voxel size.
    """
    arrays = read_grid_arrays(path)
    origin, size = read_lattice(arrays, path)
    if abs(size * alignment.scale / truth.voxel_size - 1) > _SAME_SIZE:
        raise FreeOccError(
            f"{path} has voxels of {size:g} m, the ground truth of {truth.voxel_size:g} m: make one with the other's, "
            "for a finished grid cannot be scored on another lattice."
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
    T = np.asarray(arrays.get("T_world_map", np.eye(4)), np.float64)
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
    names = [str(name).lower() for name in arrays["classes"].tolist()]
    # An export's classes begin with label 1, a ground truth's with label 0.
    names = names[1:] if "occupancy" not in arrays else names
    table = np.zeros(max(256, int(labels.max(initial=0)) + 1), np.uint8)
    table[1 : len(names) + 1] = [classes.labels.get(name, 0) for name in names]
    if not table.any():
        return Prediction(occupied), note
    predicted = np.zeros(truth.shape, np.uint8)
    predicted[inside] = table[labels[at]]
    return Prediction(occupied, np.where(occupied, predicted, 0).astype(np.uint8)), note


def _scaled(scan_map: Map, alignment: TrajectoryAlignment) -> Iterator[PosedFrame]:
    """Keyframes in the true frame, depth in its meters; a similarity scales the cameras' frames as well."""
    poses = alignment.poses(scan_map.trajectory.T_world_keyframe)
    for row, (frame, T) in enumerate(zip(scan_map.keyframes, poses, strict=True)):
        yield PosedFrame(frame.scaled(alignment.scale), T, row)


def _splatting(settings: Settings, truth: GroundTruth) -> splat.Options:
    """Layer 4's options at the truth's voxel size, on the processor wherever the map was made."""
    return settings.occupancy.changed(device="cpu", voxel_size=truth.voxel_size)


def _least_scale(settings: Settings, alignment: TrajectoryAlignment, truth: GroundTruth) -> float:
    """What the map's Gaussians are widened to on the truth's lattice, meters."""
    cell_size = settings.gaussians.cell_size or 0.5 * settings.occupancy.voxel_size
    return anchors.compute_least_scale(settings.gaussians, alignment.scale * cell_size, truth.voxel_size)


def _words(
    encoder: TextEncoder, classes: ClassMap, truth: GroundTruth
) -> tuple[TextFeatures | None, NDArray[np.uint8], str]:
    """The words that stand for scored classes and that the encoder can express, the class of each (with a last entry
    for "nothing known"), and a sentence about the truth's classes that it cannot. No words at all: (None, …)."""
    words = list(classes.words)
    text = encoder.encode_words(words)
    rows = np.flatnonzero(text.features.any(axis=1))
    reached = {classes.labels[words[row]] for row in rows}
    lacking = [classes.classes[k - 1] for k in np.unique(truth.labels) if 0 < k < UNKNOWN and k not in reached]
    note = ""
    if not len(rows):
        note = f"None of the classes is known to the map's encoder, which knows {encoder.knows}: mIoU is not available."
    elif lacking:
        note = f"The map's encoder cannot name {', '.join(lacking)}, which the truth holds: that counts as missed."
    chosen = TextFeatures(text.features[rows], tuple(text.understood[row] for row in rows)) if len(rows) else None
    return chosen, np.array([*(classes.labels[words[row]] for row in rows), 0], np.uint8), note


def encode_one_hot(labels: NDArray[np.integer] | None, classes: ClassMap, path: Path) -> NDArray[np.float32] | None:
    """(N, C) from (N,) labels 1 … C, 0 or 255 for none. Raises FreeOccError for any other."""
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
    gaussians = Gaussians(
        **fields,
        colors=np.full((n, 3), 128, np.uint8),
        anchor_keyframe=np.full(n, -1, np.int32),
        anchor_cam=fields["means"],
    )
    if "labels" in arrays:
        return gaussians, encode_one_hot(arrays["labels"].astype(np.int64), classes, path)
    semantics = arrays.get("semantics")
    if semantics is not None and semantics.shape != (n, len(classes.classes)):
        raise FreeOccError(f"'semantics' of {path} must be {(n, len(classes.classes))}, got {semantics.shape}.")
    return gaussians, None if semantics is None else semantics.astype(np.float32)
