"""The benchmark: a few frames of a real scan through every part, its tables, and what it says of what is lacking."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from helpers import data_folder

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))

import benchmark  # noqa: E402
import language  # noqa: E402
import mono  # noqa: E402
import variants  # noqa: E402


def run(*arguments: object, code: int = 0) -> str:
    command = [sys.executable, str(TOOLS / "benchmark.py"), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr


def test_every_part_of_a_few_frames(tmp_path: Path) -> None:
    bedroom = data_folder() / "house" / "bedroom"
    names = ("rgbd", "rgbd_true_poses", "rgbd_trident", *benchmark.PEERS, "query")
    printed = run("--captures", bedroom, "--variants", *names, "--frames", 8, "-o", tmp_path / "out", "--json")
    results = json.loads(printed)
    rows = {row["variant"]: row for row in results["rows"]}
    assert set(rows) == {name for name in names if name != "query"}
    for name, row in rows.items():
        assert row["available"] == (name != "rgbd_trident"), row["why"]
        if row["available"]:
            assert 0 < row["iou"] < 1
            assert row["miou"] is None
            assert row["peak_memory_bytes"] > 0
            assert all(value >= 0 for value in row["ms_per_frame"].values())
    for name in ("rgbd", "rgbd_true_poses", "dense_slam_tsdf"):
        assert rows[name]["ate_rmse_m"] < 0.05
    assert rows["rgbd"]["map_bytes"] > 0
    assert "iou" not in rows["rgbd_trident"]
    assert results["kernels"]["query"]["loaded_seconds"] > 0
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"results.json", "table.md", "iou.png", "stages.png", "trajectory_house_bedroom_rgbd.png"} <= written
    table = (tmp_path / "out" / "table.md").read_text()
    lacking = next(line for line in table.splitlines() if "rgbd_trident" in line)
    assert "**not available**, needs the networks of CLIP, DINO and SAM" in lacking
    assert "0" not in lacking.split("|")[3]
    assert benchmark.moved(results, results) == "nothing moved"


def test_lifting_has_a_row_for_each_grid() -> None:
    figures = {"copy_bytes_per_second": 8e9, "30 x 40": 4e9, "120 x 160": 2e9, "peak_memory_bytes": 6e8}
    assert [line[1] for line in language.lifting_lines(figures)] == [
        "4.0 GB/s: 0.50 of a copy's 8.0",
        "2.0 GB/s: 0.25 of a copy's 8.0",
    ]


def test_poses_from_colour_have_a_line_for_each_pipeline() -> None:
    one = {"placed": 1.0, "ate_rmse_m": 0.0123, "seconds": {"features": 3.0, "mapping": 4.0}, "cpu_seconds": 9.0}
    lines = mono.mono_lines(
        [
            {"capture": "a", "frames": 9, "ours": one, "pycolmap": {**one, "ate_rmse_m": None}},
            {"capture": "b", "error": "x"},
        ]
    )
    assert lines[3] == "| a | ours, 9 images | 100.0 | 1.23 | 3 | – | 4 | – | 7 | 9 |"
    assert lines[4] == "| a | pycolmap, 9 images | 100.0 | – | 3 | – | 4 | – | 7 | 9 |"
    assert lines[5].startswith("| b | not available, x | –")
    assert mono.mono_lines([]) == []


def test_what_moved_is_told_by_figure() -> None:
    def results(**figures: Any) -> dict[str, Any]:
        return {"rows": [{"capture": "a", "variant": "rgbd", **figures}, {"capture": "a", "variant": "x"}]}

    said = benchmark.moved(
        results(iou=0.50, ate_rmse_m=0.0100, miou=None), results(iou=0.52, ate_rmse_m=0.0101, miou=0.3)
    )
    assert said.splitlines() == ["a rgbd: IoU 50.00 -> 52.00 (+2.00)", "a rgbd: mIoU – -> 30.00"]
    one = {"rows": results()["rows"][:1]}
    assert benchmark.moved(results(), one) == "a x: not measured this time"
    assert benchmark.moved(one, results()) == "a x: new"


def test_a_figure_that_was_not_measured_is_never_a_zero() -> None:
    rows = [
        {"capture": "a", "variant": "x", "title": "X", "available": False, "why": "needs a network"},
        {"capture": "a", "variant": "y", "title": "Y", "available": True, "why": "", "iou": 0.0, "miou": None},
    ]
    lines = benchmark.markdown({"rows": rows, "kernels": {"splat": {"error": "no compiler"}}}).splitlines()
    assert lines[2].split(" | ")[2:12] == ["–"] * 10
    assert lines[3].split(" | ")[3:5] == ["0.0", "–"]
    assert lines[-1] == "splat: not available, no compiler"


def test_the_ablations_of_the_paper_are_there_by_name() -> None:
    known = variants.all_variants()
    runs = {name for name, variant in known.items() if not variant.lacking}
    assert {"rgbd", "rgbd_true_poses", "rgbd_closed_set", "rgbd_true_poses_closed_set"} <= runs
    for kind in ("rgbd", "mono"):
        for part in ("", "_no_initialisation", "_no_anchoring_no_initialisation"):
            assert kind + part in known
    assert {"mono_mast3r_slam", "mono_vggt_slam", "mono_seem", "mono_dinov2"} <= set(known)
    for variant in known.values():
        assert "\n" not in variant.lacking
        # A variant that cannot run says so in words of its own: a misspelt key of one that could would show here.
        assert variant.lacking == "" or variant.lacking.startswith("needs ")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--variants", "rgdb"), "unknown variants rgdb"),
        (("--captures", "/nowhere"), "there is no capture /nowhere"),
        (("--captures", ".", "--frames", "2"), "at least 3"),
    ],
)
def test_mistakes_are_told(arguments: tuple[str, ...], said: str) -> None:
    assert said in run(*arguments, code=2)
