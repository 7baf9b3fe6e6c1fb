"""Asks maps for what is there: how well the voxels of a class are found by its name, and how fast.

A capture is mapped with its class images and poses. Its Gaussians are projected on the truth's lattice, as ``freeocc3d
evaluate`` does: otherwise a half-voxel shift between two lattices would count as an error of the answer. The words are
the names of the classes with at least LEAST voxels in the truth. The voxels of all regions of an answer are compared
with those of the classes that the name means, where the truth is known.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from .figures import Figures, Line, tabulate_asked
from .processes import COMMAND, run_inside, run_timed
from .true_frame import put_gaussians_in_world, put_keyframes_in_world

LEAST = 30
ENOUGH = 0.5
ABSENT = ("bathtub", "bicycle")
COLD_STARTS = 5


def measure_present_words(capture: str) -> Figures:
    """IoU of each class, absent words that return something, and seconds of queries."""
    from freeocc3d.core.progress import Progress
    from freeocc3d.pipeline.run import reconstruct

    settings = {"language": {"encoder": "labels"}, "tracking": {"backend": "known"}, "fitting": {"passes": 0}}
    with tempfile.TemporaryDirectory() as folder:
        made = reconstruct(capture, Path(folder) / "map", settings, progress=Progress())
        found = classes_found(made, Path(capture) / "ground_truth.npz")
        # A new process, which imports only what queries need.
        return {**found, **run_inside("present_words:time_queries", map_path=str(made.path))}


def classes_found(scan_map: Any, truth_path: Path) -> Figures:
    """How well each class is found, in a map whose given poses are the truth's.

    iou: of the answer.  occupied: share of the class's voxels that the map holds occupied at all.  iou_occupied: of the
    answer among voxels that both hold occupied, which measures the language alone.
    """
    from freeocc3d.core.types import UNKNOWN
    from freeocc3d.evaluation.ground_truth import load_ground_truth
    from freeocc3d.occupancy import build
    from freeocc3d.query import word_query
    from freeocc3d.settings import config

    truth = load_ground_truth(truth_path)
    settings = config.load_saved(scan_map.path / "config.yaml")
    occupancy = build.build_occupancy(
        put_gaussians_in_world(scan_map),
        scan_map.gaussian_features,
        put_keyframes_in_world(scan_map),
        settings.occupancy.changed(voxel_size=truth.voxel_size),
        settings.carving,
        origin=truth.origin,
    )
    voxels = occupancy.occupied_voxels()
    inside = ((voxels >= 0) & (voxels < truth.shape)).all(axis=1)
    true = np.full(len(voxels), UNKNOWN, np.uint8)
    true[inside] = truth.labels[tuple(voxels[inside].T)]

    count = np.bincount(truth.labels.ravel(), minlength=256)
    names = [name for k, name in enumerate(truth.classes) if k and count[k] >= LEAST]
    options = word_query.Options(top_k=max(len(voxels), 1))
    rows: Figures = {}
    for result in word_query.query(occupancy, scan_map.text_encoder, names, options):
        meant = [k + 1 for k in scan_map.text_encoder.matching(result.word)[0]]
        found = np.zeros(len(voxels), bool)
        found[np.concatenate([np.zeros(0, np.int64), *(region.rows for region in result.regions)])] = True
        found &= true != UNKNOWN
        right, held = found & np.isin(true, meant), np.isin(true, meant)
        rows[result.word] = {
            "voxels": int(count[meant].sum()),
            "regions": len(result.regions),
            "iou": float(right.sum() / (found.sum() + count[meant].sum() - right.sum())),
            "occupied": float(held.sum() / count[meant].sum()),
            "iou_occupied": float(right.sum() / max(((found & (true != 0)) | held).sum(), 1)),
        }
    absent = [word for word in ABSENT if word not in truth.classes]
    answered = [r.word for r in word_query.query(occupancy, scan_map.text_encoder, absent, options) if r.matched]
    return {"classes": rows, "absent": absent, "absent_answered": answered}


def time_queries(map_path: str) -> Figures:
    """Seconds of a process that answers one word: in text, in JSON and with all details. Seconds of one word after the
    other, each for the first time, in a loaded map: median, maximum, and median of the processor time, which does not
    depend on other programs."""
    from freeocc3d.query.scan_map import load_map

    loaded = load_map(map_path)
    words = loaded.text_encoder.contrast_words()
    loaded.query_words(words[:1])
    times, of_processor = [], []
    for word in words[1:]:
        mark, mark_of_processor = time.perf_counter(), time.process_time()
        loaded.query(word)
        times.append(time.perf_counter() - mark)
        of_processor.append(time.process_time() - mark_of_processor)
    cold = {}
    for options in ((), ("--json",), ("--json", "--views")):
        command = [*COMMAND, "query", map_path, words[0], *options]
        cold[" ".join(options) or "text"] = statistics.median(run_timed(command)[0] for _ in range(COLD_STARTS))
    return {
        "cold_seconds": cold,
        "loaded_seconds": statistics.median(times),
        "loaded_most_seconds": max(times),
        "loaded_processor_seconds": statistics.median(of_processor),
    }


def tabulate_present_words(rows: list[Figures]) -> list[str]:
    """A table of all captures."""
    return tabulate_asked(present_words_lines(rows))


def present_words_lines(rows: list[Figures]) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    lines = []
    for row in rows:
        where = f"{row['capture']}, `labels`"
        if "error" in row:
            lines.append((where, f"not available, {row['error']}", ""))
            continue
        found = row["classes"]
        enough = [name for name, own in found.items() if own["iou"] >= ENOUGH]
        short = "".join(
            f"; {name}: IoU {own['iou']:.2f}, {own['occupied']:.0%} of its voxels are occupied"
            for name, own in found.items()
            if name not in enough
        )
        share = f"{len(enough)} of {len(found)}, {len(enough) / max(len(found), 1):.0%}"
        lines += [
            (f"{where}: classes found with IoU ≥ {ENOUGH}", share + short, "≥ 80 %"),
            (f"{where}: {' and '.join(row['absent'])} that return a region", f"{len(row['absent_answered'])}", "0"),
            (
                f"{where}: one word in a loaded map, median and maximum",
                f"{1e3 * row['loaded_seconds']:.1f}, {1e3 * row['loaded_most_seconds']:.1f} ms "
                f"({1e3 * row['loaded_processor_seconds']:.1f} ms processor time)",
                "≤ 30 ms",
            ),
        ]
        lines += [
            (f"{where}: cold start, {options}", f"{taken:.2f} s", "≤ 1.5 s")
            for options, taken in row["cold_seconds"].items()
        ]
    return lines
