"""Measures maps, ablations and the strongest peers that run here, on the same captures in one run.

    python tools/benchmark.py [--suite quick|full] [-o FOLDER] [--compare OLD/results.json]
    python tools/benchmark.py --captures SCAN --variants rgbd dense_slam_tsdf ours_octomap

Rows are captures x variants. A variant is an ablation of configs/ablations (mapped and scored by the command), a peer,
or another measurement. Each runs in its own process, with its own threads, memory peak and imports; this process
imports little. Times per frame count all frames of the capture, although the peers that make voxels use every second
one. Times vary by some percent with the machine's other work: compare ratios within one run.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path

from .ablations import OURS
from .comparison import describe_moves
from .figures import Figures
from .folders import DATA
from .plan_agreement import PLAN_PICTURE
from .processes import answer_inside
from .registry import SUITES, describe_variants, list_names
from .report import write_markdown
from .run import run


def draw(results: Figures, folder: Path, out: Path) -> None:
    """Plots: IoU bars, time by stage, trajectories from above with their errors, plans for robots."""
    import numpy as np

    from . import plots

    plots.iou_bars(out / "iou.png", results["rows"])
    plots.stage_bars(out / "stages.png", results["rows"])
    for number, capture in enumerate(dict.fromkeys(row["capture"] for row in results["rows"])):
        for source in (OURS, "dense_slam"):
            path = folder / str(number) / f"{source}.npz"
            if path.is_file():
                saved = np.load(path)
                name = f"trajectory_{capture.replace('/', '_')}_{source}.png"
                plots.trajectory_plot(
                    out / name, f"{capture}, {source}", saved["true"], saved["aligned"], saved["errors"], saved["up"]
                )
        if (plan := folder / str(number) / PLAN_PICTURE).is_file():
            shutil.copy(plan, out / f"plan_{capture.replace('/', '_')}.png")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="benchmark.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--suite", choices=SUITES, default="quick", help="quick: minutes; full: all captures, variants")
    parser.add_argument("--captures", nargs="+", type=Path, metavar="SCAN", help="folders of scans with poses")
    parser.add_argument("--variants", nargs="+", metavar="NAME", help="names from --list; default: all of the suite")
    parser.add_argument("--list", action="store_true", help="list the names for --variants, and which can run")
    parser.add_argument("--frames", type=int, metavar="N", help="the first N frames only")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help="write results.json, table.md and plots here"
    )
    parser.add_argument("--compare", type=Path, metavar="OLD", help="an earlier results.json: print what changed")
    parser.add_argument(
        "--before", type=Path, metavar="TREE", help="a checkout of an earlier tree, for the variant earlier_tree"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document and nothing else")
    parser.add_argument("--inside", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    captures, names = SUITES[given.suite]
    given.captures = given.captures or [DATA / name for name in captures]
    known = list_names()
    given.variants = [_current_name(name) for name in given.variants or names or known]
    if unknown := [name for name in given.variants if name not in known]:
        parser.error(f"unknown variants {', '.join(unknown)}: --list names all")
    if not given.inside and not given.list:
        for capture in given.captures:
            if not capture.is_dir():
                parser.error(f"there is no capture {capture}: name one with --captures")
    if given.frames is not None and given.frames < 3:
        parser.error("--frames needs at least 3, since fewer cannot be aligned")
    return given


def _current_name(variant: str) -> str:
    """Of a variant that may be given by the name that it had before; says so on stderr."""
    current = variant.replace("initialisation", "initialization")
    if current != variant:
        print(f"benchmark.py: the variant '{variant}' is now called '{current}'", file=sys.stderr)
    return current


def main() -> None:
    given = parse_arguments()
    if given.inside:
        answer_inside(*given.inside)
        return
    if given.list:
        print("\n".join(describe_variants()))
        return
    old = json.loads(given.compare.read_text(encoding="utf-8")) if given.compare else None
    with tempfile.TemporaryDirectory(prefix="freeocc3d-benchmark-") as temporary:
        results = run(given.captures, given.variants, given.frames, Path(temporary), given.before)
        if given.output is not None:
            given.output.mkdir(parents=True, exist_ok=True)
            (given.output / "results.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
            (given.output / "table.md").write_text(write_markdown(results) + "\n", encoding="utf-8")
            draw(results, Path(temporary), given.output)
    print(json.dumps(results) if given.json else write_markdown(results))
    if old is not None:
        print(
            f"\nmoved since {given.compare}:\n{describe_moves(old, results)}",
            file=sys.stderr if given.json else sys.stdout,
        )
