"""The objects of maps against the things of the truth.

The truth's things are the connected components (26 neighbors) of the voxels of each class, of all classes but STRUCTURE
and those that COCO's panoptic annotations count as stuff (A. Kirillov et al., Panoptic Segmentation, CVPR 2019: walls,
floors, ceilings, rugs, curtains, doors, windows). Things of one class that touch at the truth's 8 cm are one thing
there, whatever a map makes of them. ``all_classes`` counts the stuff but STRUCTURE as things too, as ScanNet does.

The map's voxels are put on the truth's lattice as ``freeocc3d evaluate`` does it; each takes the object of the map's
nearest voxel. Voxels that the truth or the map does not hold occupied do not count: the IoU of the occupancy is
measured elsewhere, and ScanNet's benchmark compares instances over points that both have, too. ``whole`` counts them.

A thing of at least LEAST voxels is found if an object has an IoU of at least ENOUGH with it. An object of at least
LEAST voxels is right if it is such an object. Objects of which more than half are things that do not count (small
things, and stuff other than STRUCTURE) are left out; pieces of walls and floors are mistakes.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .figures import Figures, tabulate

LEAST = 60
ENOUGH = 0.5
STRUCTURE = ("wall", "floor", "ceiling")
STUFF = ("carpet", "curtain", "door", "sliding door", "door handle", "window")
WAYS = {
    "class images, own poses": {"language": {"encoder": "labels"}},
    "class images, given poses": {"language": {"encoder": "labels"}, "tracking": {"backend": "known"}},
    "colors, own poses": {"language": {"encoder": "color"}},
    "colors, given poses": {"language": {"encoder": "color"}, "tracking": {"backend": "known"}},
}
MASKED = "colors, own poses"
MISTAKES = {"true masks": 0.0, "masks, a fifth wrong": 0.2, "masks, two fifths wrong": 0.4}
"""The same map divided by masks -> the share of masks that is split, of borders over which they are joined, and of
masks that are missing: each at random, anew in each keyframe. The masks are the connected components of the capture's
class images, without their names. A network's mistakes are not random: parts that all views separate are not
simulated."""
COUNTS: dict[str, tuple[tuple[str, ...], bool]] = {
    "things": (STUFF, True),
    "all_classes": ((), True),
    "whole": (STUFF, False),
}
"""What counts: classes that are left out, and whether only voxels that truth and map hold occupied count."""


def measure_objects(capture: str) -> Figures:
    """Recall, precision and seconds of the objects of four maps of a capture."""
    from freeocc3d.core.progress import Progress
    from freeocc3d.pipeline.run import reconstruct

    rows: Figures = {}
    for name, settings in WAYS.items():
        with tempfile.TemporaryDirectory() as folder:
            made = reconstruct(capture, Path(folder) / "map", settings, progress=Progress())
            truth = Path(capture) / "ground_truth.npz"
            rows[name] = score_objects(made, truth)
            if name == MASKED:
                for masked, share in MISTAKES.items():
                    rows[f"{name}, {masked}"] = score_objects(made, truth, _simulate_masks(capture, share))
    return rows


def _simulate_masks(capture: str, share: float) -> Any:
    """Gives the masks of a frame, with that share of each mistake."""
    from freeocc3d.capture.opening import open_capture
    from freeocc3d.language.encoders import labels

    images, rng = labels.load(labels.Options(), open_capture(capture)).images, np.random.default_rng(0)
    return lambda frame: disturb_masks(images(frame.index), share, rng)


def disturb_masks(classes: Any, share: float, rng: Any) -> Any:
    """(H, W) masks: the components of a class image; that share is split, and missing, and of borders joined."""
    from scipy import ndimage

    masks = np.zeros(classes.shape, np.int32)
    for k in np.unique(classes[classes > 0]):
        component, _ = ndimage.label(classes == k, np.ones((3, 3)))
        masks[component > 0] = component[component > 0] + masks.max()
    count = int(masks.max())
    pairs = np.concatenate([np.stack((a.ravel(), b.ravel()), axis=1) for a, b in
                            ((masks[:, :-1], masks[:, 1:]), (masks[:-1], masks[1:]))])  # fmt: skip
    pairs = np.unique(pairs[(pairs[:, 0] != pairs[:, 1]) & pairs.all(axis=1)], axis=0)
    becomes = np.arange(count + 1)
    for a, b in pairs[rng.permutation(len(pairs))]:
        if becomes[a] == a and rng.random() < share:
            becomes[becomes == a] = becomes[b]
    masks = becomes[masks].astype(np.int32)
    for k in np.flatnonzero(rng.random(count + 1) < share):
        rows, columns = np.nonzero(masks == k)
        if k and len(rows):
            angle, at = rng.random() * np.pi, rng.integers(len(rows))
            far = (rows - rows[at]) * np.sin(angle) + (columns - columns[at]) * np.cos(angle) > 0
            masks[rows[far], columns[far]] = masks.max() + 1
    masks[np.isin(masks, np.flatnonzero(rng.random(masks.max() + 1) < share))] = 0
    return masks


def score_objects(scan_map: Any, truth_path: Path, segment: Any = None) -> Figures:
    """Recall and precision of a map's objects; ``missed`` and ``wrong`` name the mistakes, with the best IoU."""
    from freeocc3d.evaluation.ground_truth import load_ground_truth
    from freeocc3d.query.objects.finding import find_objects

    truth = load_ground_truth(truth_path)
    start = time.perf_counter()
    objects = scan_map.objects() if segment is None else find_objects(scan_map, segment=segment)
    seconds = time.perf_counter() - start
    occupied, instance = _on_lattice(scan_map, truth, objects)
    figures: Figures = {"seconds": seconds, "objects": len(objects)}
    for name, (stuff, alone) in COUNTS.items():
        figures[name] = count_found(truth, occupied, instance, stuff, alone)
    return figures


def _on_lattice(scan_map: Any, truth: Any, objects: Any) -> tuple[Any, Any]:
    """The (X, Y, Z) voxels that the map holds occupied on the truth's lattice, and their objects; -1 for none."""
    from scipy.spatial import KDTree

    from freeocc3d.evaluation import scoring
    from freeocc3d.evaluation.scene_scoring import score_map

    scene = score_map(scan_map, truth, scoring.collect_common_classes([truth]))
    occupied = scene.predicted.occupied
    of_row = np.full(len(scan_map.occupancy.occupied_voxels()), -1)
    for number, thing in enumerate(objects):
        of_row[thing.rows] = number
    occupancy = scan_map.occupancy
    own = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges())
    T = scene.alignment
    at = (truth.centers()[occupied] - T.translation) @ T.rotation / T.scale
    instance = np.full(truth.shape, -1)
    instance[occupied] = of_row[KDTree(own).query(at)[1]]
    return occupied, instance


def count_found(truth: Any, occupied: Any, instance: Any, stuff: tuple[str, ...], alone: bool) -> Figures:
    """Recall, precision and mistakes. occupied, instance: (X, Y, Z) of the map.  stuff, alone: see COUNTS."""
    known = truth.labels != 255
    thing, names = _things(truth, stuff)
    counted = known & occupied & (truth.labels > 0) if alone else known
    objects = int(instance.max()) + 1
    size = np.bincount(thing[thing >= 0], minlength=len(names))
    # (objects + 1, things + 2): the first row is no object; the first two columns are no thing and what is left out
    left_out = np.isin(truth.labels, [k for k, name in enumerate(truth.classes) if name in stuff])
    column = np.where(left_out, 1, np.where(thing >= 0, thing + 2, 0))
    table = np.zeros((objects + 1, len(names) + 2))
    np.add.at(table, (instance[counted] + 1, column[counted]), 1)
    inside = table[1:, 2:]
    union = table[1:].sum(axis=1)[:, None] + table[:, 2:].sum(axis=0)[None] - inside
    iou = inside / np.maximum(union, 1)
    large = size >= LEAST
    best = iou.max(axis=0, initial=0)
    found = best >= ENOUGH
    own = table[1:].sum(axis=1)
    ignored = (table[1:, 1] + inside[:, ~large].sum(axis=1)) > 0.5 * own
    right = (iou[:, large] >= ENOUGH).any(axis=1)
    judged = right | ((own >= LEAST) & ~ignored)
    ends = np.array(["no thing", "left out", *names])
    return {
        "things": int(large.sum()),
        "recall": float(found[large].mean()),
        "precision": float(right[judged].mean()) if judged.any() else 0.0,
        "judged": int(judged.sum()),
        "mean_iou": float(best[large].mean()),
        "missed": [f"{names[k]} {best[k]:.2f}" for k in np.flatnonzero(large & ~found)],
        "wrong": [_describe(table[o + 1], ends) for o in np.flatnonzero(judged & ~right)],
    }


def _describe(row: Any, ends: Any) -> str:
    """What most of an object's voxels are in the truth."""
    order = [k for k in np.argsort(-row)[:3] if row[k]]
    return f"{row.sum():.0f} voxels: " + ", ".join(f"{ends[k]} {row[k]:.0f}" for k in order)


def _things(truth: Any, stuff: tuple[str, ...]) -> tuple[Any, list[str]]:
    """The (X, Y, Z) thing of each voxel, -1 for none, and the name and voxels of each."""
    from scipy import ndimage

    thing = np.full(truth.shape, -1)
    names: list[str] = []
    for k, name in enumerate(truth.classes):
        if k and name not in (*STRUCTURE, *stuff):
            component, count = ndimage.label(truth.labels == k, np.ones((3, 3, 3)))
            thing[component > 0] = component[component > 0] - 1 + len(names)
            names += [f"{name} of {n}" for n in np.bincount(component.ravel(), minlength=count + 1)[1:]]
    return thing, names


def tabulate_objects(rows: Sequence[Figures]) -> list[str]:
    """A table of all captures."""
    return tabulate(
        ("capture", "map", "things", "recall", "precision", "mean IoU", "with stuff", "with its occupancy", "seconds"),
        [
            (
                row["capture"],
                name,
                str(found["things"]["things"]),
                f"{found['things']['recall']:.2f}",
                f"{found['things']['precision']:.2f}",
                f"{found['things']['mean_iou']:.2f}",
                *(
                    f"{found[count]['recall']:.2f} / {found[count]['precision']:.2f}"
                    for count in ("all_classes", "whole")
                ),
                f"{found['seconds']:.1f}",
            )
            for row in rows
            for name, found in row.items()
            if name.startswith(tuple(WAYS))
        ],
    )
