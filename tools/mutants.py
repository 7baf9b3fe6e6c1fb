#!/usr/bin/env python3
"""Which small changes of the code its tests notice: python tools/mutants.py (make mutants)

Changes one operator, comparison, constant, border, or order of arguments of a module at a time, and runs the module's
own tests (see mutation/project.py). A test that fails, a crash, and a run past its limit notice the change. The sample
follows from the seed and the module's name and text. tools/mutants_equivalent.txt lists changes that change nothing.

It is a tool of its own because mutmut leaves decorated functions alone, which all of Numba's kernels are, and
cosmic-ray knows neither which tests are a module's own nor which modules' compiled kernels a change makes stale.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from mutation import trial
from mutation.changes import Change, make_change, sample_changes
from mutation.project import Project

REPOSITORY = Path(__file__).resolve().parents[1]
ROOMS = ("tracking", "depth", "gaussians", "language", "occupancy", "export", "evaluation")
OUTCOMES = ("noticed", "survived", "equivalent")


@dataclass(frozen=True)
class Tried:
    """A change and what became of it: one of OUTCOMES, or "untested" if the module has no tests."""

    name: str
    line: int
    before: str
    after: str
    outcome: str
    seconds: float

    @property
    def module(self) -> str:
        """room/part, as in the package."""
        return self.name.split("#")[0]


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 0 if enough is noticed."""
    options = _parser().parse_args(arguments)
    project = Project(options.root.resolve(), options.package)
    chosen = list(_choose(project, options))
    print(f"{len(chosen)} changes, seed {options.seed}, {options.per_module} a module", flush=True)
    tried = []
    for one in try_changes(project, chosen, options.root / options.equivalent, options.jobs, options.work):
        tried.append(one)
        place = f"{options.package}/{one.module}.py:{one.line}"
        print(f"{one.outcome:10} {one.seconds:6.1f} s  {one.name}  {place}: {one.before}  ->  {one.after}", flush=True)
        if options.json:
            options.json.write_text(json.dumps([asdict(one) for one in tried], indent=1), encoding="utf-8")
    print("\n".join(_table(tried, options.package)))
    counts = Counter(one.outcome for one in tried)
    return int(counts["noticed"] < options.least * (len(tried) - counts["equivalent"]))


def try_changes(
    project: Project, chosen: Sequence[tuple[str, Change]], equivalent: Path, jobs: int = 1, work: Path | None = None
) -> Iterator[Tried]:
    """Yields each change of a module with what became of it. Raises ValueError for a wrong list.

    equivalent: list of changes that change nothing.  jobs: processes at a time.  work: folder of compiled kernels and
    times that is kept for the next run.
    """
    known = _read_equivalent(equivalent)
    trial.warm_up(project)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copies = trial.Copies(project, work or Path(folder))
        running: dict[Path, tuple[tuple[int, float], str, Change, float]] = {}
        waiting = list(enumerate(chosen))[::-1]
        while waiting or running:
            while waiting and len(running) < jobs:
                number, (module, change) = waiting.pop()
                is_known = (module, change.before, change.after) in known
                tests = [] if is_known else copies.passing(project.own_tests(module))
                if not tests:
                    yield _tried(module, change, "equivalent" if is_known else "untested")
                    continue
                copy = copies.folder / f"changed-{number}"
                began = time.monotonic()
                running[copy] = copies.start(module, change.source, tests, copy), module, change, began
            for copy, (child, module, change, began) in list(running.items()):
                if (outcome := trial.poll(child)) is not None:
                    del running[copy]
                    copies.drop(copy)
                    said = "survived" if outcome.passed else "noticed"
                    yield _tried(module, change, said, time.monotonic() - began)
            time.sleep(0.02)


def _tried(module: str, change: Change, outcome: str, seconds: float = 0.0) -> Tried:
    name = f"{module}#{change.number}"
    return Tried(name, change.line, change.before, change.after, outcome, round(seconds, 1))


def _choose(project: Project, options: argparse.Namespace) -> Iterator[tuple[str, Change]]:
    for module, path in project.modules.items():
        source = path.read_text(encoding="utf-8")
        if options.only:
            numbers = [name.split("#")[1] for name in options.only if name.split("#")[0] == module]
            yield from ((module, make_change(source, number)) for number in numbers)
        elif any(fnmatch.fnmatch(module, pattern) for pattern in options.modules):
            seed = f"{options.seed} {module}"
            yield from ((module, change) for change in sample_changes(source, seed, options.per_module))


def _read_equivalent(path: Path) -> set[tuple[str, str, str]]:
    """Module, before and after of the changes that change nothing. Each line: module | before | after | reason."""
    if not path.exists():
        return set()
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    parts = [[part.strip() for part in line.split(" || ")] for line in lines]
    if wrong := [line for line, part in zip(lines, parts, strict=True) if len(part) != 4 or not all(part)]:
        raise ValueError(f"{path}: this line is not 'module || before || after || reason': {wrong[0]}")
    return {(module, before, after) for module, before, after, _ in parts}


def _table(tried: Sequence[Tried], package: str) -> Iterator[str]:
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    for one in tried:
        for row in (one.module, one.module.split("/")[0] + "/*", "all"):
            rows[row][one.outcome] += 1
    width = max(map(len, rows), default=0)
    yield f"\n{'module':{width}}  tried  noticed  survived  equivalent"
    for row in sorted(rows, key=lambda row: (row == "all", row.endswith("*"), row)):
        counts = rows[row]
        survived = counts["survived"] + counts["untested"]
        total = sum(counts.values())
        share = f"{counts['noticed'] / max(1, total - counts['equivalent']):6.0%}"
        yield f"{row:{width}}  {total:5}  {counts['noticed']:7}  {survived:8}  {counts['equivalent']:10} {share}"
    yield ""
    for one in tried:
        if one.outcome in ("survived", "untested"):
            yield f"{package}/{one.module}.py:{one.line}: {one.before}  ->  {one.after}   (--only {one.name})"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="mutants.py", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seed", default="0", help="what the sample follows from")
    parser.add_argument("--per-module", type=int, default=2, metavar="N", help="changes of each module")
    patterns = [f"{room}/*" for room in ROOMS]
    parser.add_argument("--modules", nargs="+", default=patterns, metavar="PATTERN", help="such as 'occupancy/*'")
    parser.add_argument("--only", nargs="+", metavar="ID", help="changes, such as 'occupancy/carve#42.0'")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="tests that run at a time")
    parser.add_argument("--least", type=float, default=0.9, metavar="SHARE", help="to be noticed; else it exits 1")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the results are written as well")
    parser.add_argument("--work", type=Path, metavar="FOLDER", help="keeps compiled kernels and times for the next run")
    parser.add_argument("--root", type=Path, default=REPOSITORY, help=argparse.SUPPRESS)
    parser.add_argument("--package", default="freeocc3d", help=argparse.SUPPRESS)
    parser.add_argument("--equivalent", default="tools/mutants_equivalent.txt", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
