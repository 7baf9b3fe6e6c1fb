"""Writes an evaluation as one self-contained HTML file: figures, classes, confusions, trajectories, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..core.errors import DependencyError
from ..viewer.grid_pictures import LabelGrid, draw_grids
from ..viewer.palette import assign_class_colors, color_by_value
from ..viewer.scene_rendering import CUT, turn_upright
from ..viewer.self_contained_pages import embed_image, make_environment, write_page
from .scene_scoring import ScoredScene
from .scoring import PRIMARY_MASK, TOP, Evaluation

MOST_SEGMENTS = 2000
"""Most pieces of a drawn trajectory."""

NO_CLASS = "occupied, no class"
NOT_OCCUPIED = "not occupied"
_PLAIN = (120, 150, 190)  # color of a voxel without a known class

DIFFERENCES = {
    "right": (176, 190, 176),
    "wrong class": (245, 170, 40),
    "missed": (40, 110, 220),
    "invented": (220, 50, 50),
}
"""The kinds of voxels in the picture of differences, with their colors."""


def write_report(evaluation: Evaluation, path: Path, overwrite: bool = False) -> None:
    """Writes the page. The same evaluation gives the same page. If pictures cannot be rendered, the page says why.

    Raises ExportError: the file exists, or cannot be written.
    """
    write_page(path, _page(evaluation), overwrite)


def _page(evaluation: Evaluation) -> str:
    environment = make_environment("evaluation")
    environment.filters |= {"percent": _percent, "cm": _cm, "count": lambda number: f"{number:,}"}
    environment.globals |= {"rgb": _rgb}
    scores = evaluation.scores
    return environment.get_template("report.html").render(
        version=__version__,
        evaluation=evaluation,
        scores=scores,
        mask=PRIMARY_MASK,
        miou=evaluation.miou(),
        masks=[(name, own, evaluation.miou(mask=name)) for name, own in evaluation.by_mask.items()],
        lists=_lists(evaluation),
        classes=_classes(evaluation),
        confusion=_confusion(evaluation) if evaluation.has_classes else None,
        scenes=[_scene(own) for own in evaluation.by_scene],
        differences=DIFFERENCES,
        cut=CUT,
    )


def _lists(evaluation: Evaluation) -> list[dict[str, Any]]:
    """Returns mIoU over each list of classes, or why there is none."""
    rows = []
    for name, names in evaluation.miou_over.items():
        why = ""
        if not evaluation.has_classes:
            why = "the prediction has no classes"
        elif names is None:
            count = len(evaluation.scores.present)
            top = name in {f"top_{k}" for k in TOP}
            why = f"the truth holds {count} classes" if top else "the classes differ: map them with --classes"
        absent = [c for c in names or () if c in evaluation.absent]
        rows.append({
            "name": name, "miou": None if why else evaluation.miou(names), "why": why, "names": names or (),
            "absent": absent,
        })  # fmt: skip
    return rows


def _classes(evaluation: Evaluation) -> list[dict[str, Any]]:
    """Returns each class that the truth or the prediction holds, most frequent first: its IoU, the share of it that was
    found occupied, and the classes that the prediction gives it."""
    scores = evaluation.scores
    matrix = scores.matrix
    colors = assign_class_colors(list(evaluation.classes))
    columns = [NOT_OCCUPIED, *evaluation.classes, NO_CLASS]
    rows = []
    for k in np.argsort(-scores.class_voxels, kind="stable"):
        row = matrix[k + 1]
        if not row.sum() and not matrix[:, k + 1].sum():
            continue
        others = [
            int(c) for c in np.argsort(-row, kind="stable") if c != k + 1 and 100 * row[c] >= row.sum() and row[c]
        ]
        rows.append({
            "name": evaluation.classes[k],
            "color": colors[k + 1],
            "iou": float(scores.class_iou[k]) if evaluation.has_classes else None,
            "found": float(row[1:].sum() / row.sum()) if row.sum() else None,
            "voxels": int(row.sum()),
            "taken_for": [(columns[c], float(row[c] / row.sum())) for c in others[:3]],
            "counted": evaluation.classes[k] in evaluation.classes_in_miou,
        })  # fmt: skip
    return rows


def _confusion(evaluation: Evaluation) -> dict[str, Any]:
    """Returns the confusion matrix as shares of its rows, without the classes that occur in neither."""
    matrix = evaluation.scores.matrix
    occurs = matrix[1:].sum(axis=1) + matrix[:, 1:-1].sum(axis=0) > 0
    kept = np.flatnonzero(np.concatenate(([True], occurs)))
    columns = np.append(kept, matrix.shape[1] - 1)
    shown = matrix[np.ix_(kept, columns)]
    total = shown.sum(axis=1)
    share = shown / np.maximum(total, 1)[:, None]
    names = np.array(["free", *evaluation.classes], object)
    return {
        "rows": list(zip(names[kept], total.tolist(), shown.tolist(), share.tolist(), strict=True)),
        "columns": [NOT_OCCUPIED, *names[kept[1:]], NO_CLASS],
        "left_out": len(evaluation.classes) - int(occurs.sum()),
    }


def _scene(own: Evaluation) -> dict[str, Any]:
    """Returns the page's values for one scene."""
    scene = own.scenes[0]
    pictures, lacking = _pictures(own)
    mask = scene.truth.masks()[PRIMARY_MASK]
    known = np.unique(scene.truth.labels[mask])
    if scene.predicted.labels is not None:
        known = np.union1d(known, scene.predicted.labels[mask])
    colors = assign_class_colors(list(own.classes))
    return {
        "name": scene.name,
        "scores": own.scores,
        "miou": own.miou(),
        "scene": scene,
        "shape": scene.truth.shape,
        "voxel_size": scene.truth.voxel_size,
        "trajectory": None if scene.errors is None else _drawn_way(scene),
        "pictures": pictures,
        "lacking": lacking,
        "legend": [(own.classes[k - 1], colors[k]) for k in known if k > 0],
    }


def _pictures(own: Evaluation) -> tuple[dict[str, str], str]:
    """Returns the pictures of the truth, the prediction and the difference as data addresses, or why there are none."""
    scene = own.scenes[0]
    truth, predicted, mask = scene.truth, scene.predicted, scene.truth.masks()[PRIMARY_MASK]
    true_way = np.zeros((0, 3)) if scene.errors is None else scene.errors.true
    way = np.zeros((0, 3)) if scene.errors is None else scene.errors.aligned
    palette = np.vstack((assign_class_colors(list(own.classes)), [_PLAIN])).astype(np.uint8)
    plain = len(palette) - 1
    true = np.where(mask, truth.labels, 0)
    occupied = predicted.occupied & mask
    labels = np.zeros(truth.shape, np.uint8) if predicted.labels is None else predicted.labels
    claimed = np.where(occupied, np.where(labels > 0, labels, plain), 0).astype(np.uint8)
    grids = {
        "Truth": LabelGrid(true.astype(np.uint8), palette, true_way),
        "Prediction": LabelGrid(claimed, palette, way),
        "Difference": LabelGrid(compare_voxels(true, occupied, predicted.labels), _difference_colors(), way),
    }
    try:
        pictures = draw_grids(grids, truth.origin, truth.voxel_size, scene.up)
    except DependencyError as error:
        return {}, f"There are no pictures. {error}"
    if not pictures:
        return {}, "There are no pictures: neither the truth nor the prediction has occupied voxels."
    return {name: embed_image("png", picture) for name, picture in pictures.items()}, ""


def compare_voxels(
    true: NDArray[np.integer], occupied: NDArray[np.bool_], labels: NDArray[np.integer] | None
) -> NDArray[np.uint8]:
    """Returns (X, Y, Z): 0 where both are free, else 1 + the index in ``DIFFERENCES``.

    true: (X, Y, Z), 0 free, k class k.  labels: (X, Y, Z), as ``Prediction.labels``; without them no class is wrong.
    """
    both = (true > 0) & occupied
    wrong = both & (labels != true) if labels is not None else np.zeros_like(both)
    out = np.zeros(true.shape, np.uint8)
    for number, where in enumerate((both & ~wrong, wrong, (true > 0) & ~occupied, occupied & (true == 0))):
        out[where] = number + 1
    return out


def _difference_colors() -> NDArray[np.uint8]:
    return np.array([(0, 0, 0), *DIFFERENCES.values()], np.uint8)


def _drawn_way(scene: ScoredScene) -> dict[str, Any]:
    """Returns the trajectories from above, in centimeters, with y down as on screens: points of the true one, and
    pieces of the estimated one with the color of their error."""
    errors = scene.errors
    assert errors is not None
    R = turn_upright(scene.up, errors.true)
    step = max(1, -(-len(errors.true) // MOST_SEGMENTS))
    true, way = (100 * (points @ R.T)[::step, :2] * (1, -1) for points in (errors.true, errors.aligned))
    low = np.minimum(true.min(axis=0), way.min(axis=0))
    extent = np.maximum(true.max(axis=0), way.max(axis=0)) - low
    true, way = true - low, way - low
    off = errors.errors_m[::step]
    worst = max(float(errors.errors_m.max()), 1e-9)
    colors = color_by_value(1 - 0.85 * off / worst)  # leaves out the palest colors, which are invisible on white
    unit = max(float(extent.max()), 1.0)
    return {
        "box": (-0.04 * unit, -0.04 * unit, extent[0] + 0.08 * unit, extent[1] + 0.08 * unit),
        "unit": unit,
        "true": " ".join(f"{x:.1f},{y:.1f}" for x, y in true),
        "pieces": [(*a, *b, _rgb(color)) for a, b, color in zip(way[:-1], way[1:], colors[1:], strict=True)],
        "start": true[0],
        "worst": worst,
        "key": [_rgb(color) for color in color_by_value(1 - 0.85 * np.linspace(0, 1, 24))],
    }


def _rgb(color: Sequence[int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*(int(c) for c in color))


def _percent(fraction: float | None) -> str:
    return "not available" if fraction is None else f"{100 * fraction:.1f}"


def _cm(meters: float | None) -> str:
    return "not available" if meters is None else f"{100 * meters:.2f} cm"
