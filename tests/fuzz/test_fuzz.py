"""A short run of each part, with a fixed seed; ``make fuzz`` is the long one. And the harness notices what it must."""

import pytest

from fuzz import harness
from fuzz._ends import ENDS

SEED = 7


@pytest.mark.parametrize("part", harness.parts())
def test_damaged_inputs_are_refused_with_a_sentence(part: str) -> None:
    results = harness.run_part(part, range(harness.short_length(part)), SEED)
    failures = [harness.failure(result) for result in results if result.outcome not in harness.SOUND]
    assert not failures, "\n".join(failures)
    assert part == "checkpoints" or {result.outcome for result in results} & {"refused"}  # those are made again


def test_the_harness_tells_all_ends() -> None:
    """With one process for all, which is replaced when it dies."""
    limits = harness.Limits(hang_s=1.0, most_bytes=600 << 20, runaway_bytes=2 << 30)
    results = harness.run_part("_ends", range(len(ENDS)), limits=limits)
    assert {result.description: result.outcome for result in results} == {name: name.split(",")[0] for name in ENDS}
    assert "boom" in results[list(ENDS).index("traceback")].detail


def test_the_table_counts_all_ends() -> None:
    results = [harness.Result("a", n, name, "", "", 1.0) for n, name in enumerate(harness.OUTCOMES)]
    rows = [
        line.split() for line in harness.table([*results, harness.Result("b", 0, "hang", "", "", 1.0)]).splitlines()
    ]
    assert rows[1] == ["a", *["1"] * len(harness.OUTCOMES), "7", "7"]
    assert rows[-1][0] == "all"
    assert rows[-1][1 + harness.OUTCOMES.index("hang")] == "2"
