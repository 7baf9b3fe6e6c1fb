"""An evaluation, as text and as the document of ``evaluate --json``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from .. import __version__

if TYPE_CHECKING:
    from ..evaluation.scene_scoring import ScoredScene
    from ..evaluation.scoring import Evaluation


def scores_document(evaluation: Evaluation) -> dict[str, Any]:
    """Plain values: fractions 0 to 1, meters, seconds. For several scenes, ``scenes`` holds the document of each."""
    alone = evaluation.scenes[0] if len(evaluation.scenes) == 1 else None
    document: dict[str, Any] = {
        "version": __version__,
        "scored": [scene.name for scene in evaluation.scenes],
        **_figures(evaluation),
        "classes": list(evaluation.classes),
        "ate_rmse_m": evaluation.ate_rmse_m,
        "frames_with_pose": _total(scene.frames_with_pose for scene in evaluation.scenes),
        "frames": _total(scene.frames for scene in evaluation.scenes),
        "align": evaluation.how,
        "alignment": alone.alignment.as_dict() if alone else None,
        "trajectory": alone.errors.as_dict() if alone and alone.errors else None,
        "confusion": {
            "rows_true": ["free", *evaluation.classes],
            "columns_predicted": ["not occupied", *evaluation.classes, "occupied, no class"],
            "voxels": evaluation.scores.matrix.tolist(),
        },
        "notes": list(evaluation.notes),
    }
    if alone is None:
        document["scenes"] = [scores_document(own) for own in evaluation.by_scene]
    return document


def _figures(evaluation: Evaluation) -> dict[str, Any]:
    """IoU and mIoU, with their classes and masks."""
    from ..evaluation.scoring import PRIMARY_MASK

    scores = evaluation.scores
    per_class = dict(zip(evaluation.classes, scores.class_iou.tolist(), strict=True))
    counted = evaluation.classes_in_miou if evaluation.has_classes else ()
    return {
        "iou": scores.iou,
        "precision": scores.precision,
        "recall": scores.recall,
        "miou": evaluation.miou(),
        "classes_in_miou": list(counted),
        "per_class": {name: per_class[name] for name in counted},
        "absent": list(evaluation.absent),
        "miou_over": {
            name: None if names is None else {"miou": evaluation.miou(names), "classes": list(names)}
            for name, names in evaluation.miou_over.items()
        },
        "mask": PRIMARY_MASK,
        "by_mask": {
            name: {
                "iou": own.iou,
                "miou": evaluation.miou(mask=name),
                "precision": own.precision,
                "recall": own.recall,
                "voxels": own.voxels,
            }
            for name, own in evaluation.by_mask.items()
        },
    }


def scores_lines(evaluation: Evaluation) -> list[str]:
    """Tables for people; percent and centimeters."""
    scores = evaluation.scores
    lines = [
        f"IoU        {_percent(scores.iou)}  precision {_percent(scores.precision)}, recall {_percent(scores.recall)}",
        *(
            f"  mask {name:<9} IoU {_percent(own.iou)}, mIoU {_percent(evaluation.miou(mask=name))}, "
            f"{own.voxels:,} voxels"
            for name, own in evaluation.by_mask.items()
        ),
        f"mIoU       {_percent(evaluation.miou())}  over {_list(evaluation.classes_in_miou)}",
    ]
    if evaluation.has_classes:
        lines += _lists_of_classes(evaluation)
    for own in evaluation.by_scene:
        (scene,) = own.scenes
        if len(evaluation.scenes) > 1:
            lines.append(f"{scene.name}: IoU {_percent(own.scores.iou)}, mIoU {_percent(own.miou())}")
        lines += _trajectory(scene, evaluation.how)
    if evaluation.has_classes:
        lines.append("class                     IoU   true voxels")
        lines += [
            f"  {evaluation.classes[k]:<20} {_percent(scores.class_iou[k])}  {scores.class_voxels[k]:12,}"
            for k in (-scores.class_voxels).argsort(kind="stable")
            if scores.class_voxels[k]
        ]
    return lines + [f"note: {note}" for note in evaluation.notes]


def _lists_of_classes(evaluation: Evaluation) -> list[str]:
    """mIoU over the usual lists of classes."""
    lines, lacking = [], []
    for name, names in evaluation.miou_over.items():
        if names is None:
            lacking.append(name)
        elif name == "listed":
            absent = f", absent ones as 0: {', '.join(evaluation.absent)}" if evaluation.absent else ""
            lines.append(f"  {name:<14} {_percent(evaluation.miou(names))}  over all {len(names)} classes{absent}")
        elif names != evaluation.classes_in_miou:
            lines.append(f"  {name:<14} {_percent(evaluation.miou(names))}  over {_list(names)}")
    named = [name for name in lacking if not name.startswith("top_")]
    top = [name for name in lacking if name.startswith("top_")]
    if named:
        lines.append(f"  not available  {', '.join(named)} (the classes differ: map them with --classes)")
    if top:
        count = len(evaluation.scores.present)
        lines.append(f"  not available  {', '.join(top)} (the truth holds {count} classes)")
    return lines


def _trajectory(scene: ScoredScene, how: str) -> list[str]:
    errors = scene.errors
    if errors is None:
        return []
    first = (
        f"ATE        {100 * errors.ate_rmse_m:.2f} cm RMSE, {100 * errors.errors_m.max():.2f} cm maximum, "
        f"{len(errors.errors_m)} frames, aligned by {how}"
        + (f" (scale {scene.alignment.scale:.4f})" if how == "sim3" else "")
    )
    return [
        first,
        *(
            f"  RPE over {e.distance_m:g} m   {100 * e.translation_rmse_m:.2f} cm, {e.rotation_rmse_deg:.2f} deg "
            f"({e.pairs} pairs)"
            for e in errors.relative
        ),
    ]


def _percent(fraction: float | None) -> str:
    return "    –" if fraction is None else f"{100 * fraction:5.1f}"


def _list(names: Sequence[str]) -> str:
    return f"{len(names)} class{'es' if len(names) != 1 else ''}: {', '.join(names) or 'none'}"


def _total(counts: Iterable[int | None]) -> int | None:
    known = [count for count in counts if count is not None]
    return sum(known) if known else None
