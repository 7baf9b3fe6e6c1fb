"""Asks maps for things that are not there, and counts how often they return a region.

A capture with class images is mapped with the encoder ``labels``; other captures with ``segmenter`` and the network in
the models folder. The words are names of LVIS and Objects365 (``clip_text_names.npz``), evenly spread over the names of
things that the scene does not hold. A name is absent unless the scene holds it, a synonym, the kind that its last word
names, or a wider or narrower word. The ground truth says what a scene holds; where it has no classes, its images do
(``SEEN``).
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from .figures import Figures, Line, tabulate_asked
from .folders import MODELS
from .processes import PartFailed

ABSENT = 200
ASKED = 0.05

SEEN = {
    "7scenes-kitchen": (
        "wall", "floor", "carpet", "door", "window", "table", "chair", "cabinet", "counter", "shelf", "sink", "tap",
        "television", "monitor", "cup", "bowl", "box", "plastic box", "book", "magazine", "brochure", "newspaper",
        "paper", "envelope", "postcard", "poster", "picture", "power outlet", "switch", "cable", "game controller",
        "remote control", "trash can",
    ),
}  # fmt: skip
"""What the images of captures without true classes show."""

SEGMENTER = {
    "model": str(MODELS / "enet_nyu40.onnx"),
    "classes": str(MODELS / "nyu40.txt"),
    "embeddings": str(MODELS / "clip_text_names.npz"),
    "mean": [0.496342, 0.466664, 0.440796],
    "std": [0.277856, 0.28623, 0.291129],
}


def absent_names(names: list[str], present: list[str]) -> list[str]:
    """The names of nothing that is present, in alphabetical order."""
    from freeocc3d.language.class_names import match_names

    return sorted({name for name in names if not match_names(name, present)[0]})


def spread(names: list[str]) -> list[str]:
    """ABSENT of the names, evenly spread."""
    return [names[int((n + 0.5) * len(names) / ABSENT)] for n in range(ABSENT)] if len(names) > ABSENT else names


def measure_absent_words(capture: str) -> Figures:
    """Shares of the absent names, and of the present classes' names, that return a region."""
    from freeocc3d.core.progress import Progress
    from freeocc3d.pipeline.run import reconstruct

    if not MODELS.is_dir():
        raise PartFailed(f"there are no names to ask for: the folder {MODELS} is missing")
    names = [str(name) for name in np.load(MODELS / "clip_text_names.npz")["names"]]
    present = scene_classes(Path(capture))
    seen = list(present or SEEN.get(Path(capture).name, ()))
    if not seen:
        raise PartFailed(f"the things in {capture} are not known: add them to SEEN of tools/benchmark/absent_words.py")
    language = {"encoder": "labels"} if present else {"encoder": "segmenter", "segmenter": SEGMENTER}
    tracking = {"backend": "known"} if present else {}
    settings = {"language": language, "tracking": tracking, "fitting": {"passes": 0}}
    with tempfile.TemporaryDirectory() as folder:
        made = reconstruct(capture, Path(folder) / "map", settings, progress=Progress())
        occupied = len(made.occupancy.colors)
        absent = absent_names(names, seen)
        asked = spread(absent)
        answered = {result.word: result for result in made.query_words(absent) if result.matched}
        classes = [name for name in made.vocabulary if name in seen]
        found = [result.word for result in made.query_words(classes) if result.matched]
    return {
        "encoder": language["encoder"],
        "absent": len(asked),
        "absent_answered": sum(word in answered for word in asked) / len(asked),
        "all_absent": len(absent),
        "all_absent_answered": len(answered) / len(absent),
        "answered": {
            word: {
                "understood": result.understood,
                "voxels": sum(region.voxels for region in result.regions) / occupied,
                "score": result.regions[0].score,
            }
            for word, result in answered.items()
        },
        "present": len(classes),
        "present_found": len(found) / max(len(classes), 1),
        "not_found": [name for name in classes if name not in found],
    }


def scene_classes(capture: Path) -> tuple[str, ...]:
    """Names of the classes in a capture's ground truth; none if it holds geometry only."""
    from freeocc3d.evaluation.ground_truth import load_ground_truth

    path = capture / "ground_truth.npz"
    if not path.is_file():
        return ()
    truth = load_ground_truth(path)
    held = np.unique(truth.labels)
    names = tuple(truth.classes[k] for k in held if 0 < k < len(truth.classes))
    return names if len(truth.classes) > 2 else ()


def tabulate_absent_words(rows: list[Figures]) -> list[str]:
    """A table of all captures."""
    return tabulate_asked(absent_words_lines(rows))


def absent_words_lines(rows: list[Figures]) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    lines = []
    for row in rows:
        where = f"{row['capture']}, `{row.get('encoder', '?')}`"
        if "error" in row:
            lines.append((where, f"not available, {row['error']}", ""))
            continue
        lines.append(
            (f"{where}: {row['absent']} absent names that return a region", f"{row['absent_answered']:.1%}", "≤ 5 %")
        )
        lines.append(
            (f"{where}: all {row['all_absent']} that return a region", f"{row['all_absent_answered']:.1%}", "")
        )
        missing = f" (not: {', '.join(row['not_found'])})" if row["not_found"] else ""
        lines.append(
            (f"{where}: {row['present']} present classes that are found", f"{row['present_found']:.0%}{missing}", "")
        )
    return lines
