"""Comparing with an earlier tree runs that tree, from wherever the benchmark is started."""

from pathlib import Path

import pytest
from benchmark import earlier_tree
from benchmark.folders import REPOSITORY
from benchmark.processes import COMMAND, PartFailed


def test_the_other_tree_runs_also_from_the_folder_of_this_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "freeocc3d" / "cli").mkdir(parents=True)
    (tmp_path / "freeocc3d" / "__init__.py").touch()
    (tmp_path / "freeocc3d" / "cli" / "__init__.py").touch()
    marks = "from pathlib import Path; import sys; Path(sys.argv[1]).touch()"
    (tmp_path / "freeocc3d" / "cli" / "__main__.py").write_text(marks)
    monkeypatch.chdir(REPOSITORY)
    wall, processor = earlier_tree._timed([*COMMAND, str(tmp_path / "ran")], str(tmp_path))
    assert (tmp_path / "ran").exists()
    assert wall > 0
    assert processor > 0


def test_without_a_tree_it_says_what_to_name() -> None:
    with pytest.raises(PartFailed, match="--before"):
        earlier_tree.measure_earlier_tree("scan", None)


def test_ratios_stand_beside_what_is_asked() -> None:
    seconds = {"cold query": {"wall": {"now": 0.51, "before": 0.5}}}
    ((what, measured, asked),) = earlier_tree.earlier_tree_lines({"seconds": seconds})
    assert what == "cold query, wall time over the earlier tree's"
    assert measured.startswith("1.020 ")
    assert asked == "≤ 1.02"
