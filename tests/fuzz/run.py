"""Tries damaged inputs, counts how they end, and shows each failure: ``make fuzz``, or

python tests/fuzz/run.py --inputs 2000 --part maps --seed 1
python tests/fuzz/run.py --part maps --only 1234
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

for _folder in (Path(__file__).parents[2], Path(__file__).parents[1]):
    if str(_folder) not in sys.path:
        sys.path.insert(0, str(_folder))

from fuzz import harness  # noqa: E402


def main() -> int:
    """Run what the command line asks for; 1 if an input fails."""
    asked = _arguments().parse_args()
    chosen = asked.part or harness.parts()
    results: list[harness.Result] = []
    weights = {part: harness.short_length(part) for part in chosen}  # an input of a part with a short run takes long
    for part in chosen:
        share = -(-asked.inputs * weights[part] // sum(weights.values()))
        numbers = range(share) if asked.only is None else range(asked.only, asked.only + 1)
        results += harness.run_part(part, numbers, asked.seed, asked.jobs, _Told(part, len(numbers)))
        if asked.only is not None:
            print(results[-1].outcome, results[-1].description, results[-1].detail, sep="\n")
    failures = [result for result in results if result.outcome not in harness.SOUND]
    print(f"seed {asked.seed}", harness.table(results), sep="\n")
    if asked.json is not None:
        asked.json.write_text(json.dumps(_document(asked.seed, results, failures), indent=1), encoding="utf-8")
    return bool(failures)


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Try damaged inputs.")
    parser.add_argument("--part", action="append", choices=harness.parts(), help="only this part; repeatable")
    parser.add_argument("--inputs", type=int, default=10_000, help="number of inputs, over all parts")
    parser.add_argument("--only", type=int, metavar="N", help="only the input with this number")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the counts and the failures")
    return parser


class _Told:
    """Shows each failure when it is there, and how far a part is."""

    def __init__(self, part: str, inputs: int):
        self._part, self._inputs, self._done = part, inputs, 0

    def __call__(self, result: harness.Result) -> None:
        self._done += 1
        if result.outcome not in harness.SOUND:
            print(harness.failure(result), flush=True)
        if self._done % 500 == 0:
            print(f"{self._part}: {self._done} of {self._inputs}", file=sys.stderr, flush=True)


def _document(seed: int, results: list[harness.Result], failures: list[harness.Result]) -> dict[str, object]:
    names = dict.fromkeys(result.part for result in results)
    counts = {name: Counter(result.outcome for result in results if result.part == name) for name in names}
    stopped = [(result.outcome, result.description) for result in results if result.part == "checkpoints"]
    failed = [result._asdict() for result in failures]
    return {"seed": seed, "counts": counts, "failures": failed, "checkpoints": stopped}


if __name__ == "__main__":
    sys.exit(main())
