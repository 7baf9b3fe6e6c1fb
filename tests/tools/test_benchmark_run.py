"""The benchmark: a few frames of a real scan through every part, its tables, and its words for what is missing."""

import json
from pathlib import Path
from typing import Any

import pytest
from benchmark import lifting_speed, poses_from_color
from benchmark.ablations import read_ablations
from benchmark.comparison import describe_moves
from benchmark.report import write_markdown
from benchmark_runs import run_benchmark
from small_captures import data_folder


def test_every_part_of_a_few_frames(tmp_path: Path) -> None:
    bedroom = data_folder() / "house" / "bedroom"
    names = ("rgbd", "rgbd_trident", "dense_slam_tsdf", "query")
    printed = run_benchmark(
        "--captures", bedroom, "--variants", *names, "--frames", 8, "-o", tmp_path / "out", "--json"
    )
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
    for name in ("rgbd", "dense_slam_tsdf"):
        assert rows[name]["ate_rmse_m"] < 0.05
    assert rows["rgbd"]["map_bytes"] > 0
    assert "iou" not in rows["rgbd_trident"]
    assert results["measurements"]["query"][0]["loaded_seconds"] > 0
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"results.json", "table.md", "iou.png", "stages.png", "trajectory_house_bedroom_rgbd.png"} <= written
    table = (tmp_path / "out" / "table.md").read_text()
    lacking = next(line for line in table.splitlines() if "rgbd_trident" in line)
    assert "**not available**, needs the networks of CLIP, DINO and SAM" in lacking
    assert "0" not in lacking.split("|")[3]
    assert describe_moves(results, results) == "nothing moved"


def test_lifting_has_a_row_for_each_grid() -> None:
    figures = {"copy_bytes_per_second": 8e9, "30 x 40": 4e9, "120 x 160": 2e9, "peak_memory_bytes": 6e8}
    assert [line[1] for line in lifting_speed.lifting_lines(figures)] == [
        "4.0 GB/s: 0.50 of a copy's 8.0",
        "2.0 GB/s: 0.25 of a copy's 8.0",
    ]


def test_poses_from_color_have_a_line_for_each_pipeline() -> None:
    one = {"placed": 1.0, "ate_rmse_m": 0.0123, "seconds": {"features": 3.0, "mapping": 4.0}, "cpu_seconds": 9.0}
    lines = poses_from_color.tabulate_poses_from_color(
        [
            {"capture": "a", "frames": 9, "ours": one, "pycolmap": {**one, "ate_rmse_m": None}},
            {"capture": "b", "error": "x"},
        ]
    )
    assert lines[3] == "| a | ours, 9 images | 100.0 | 1.23 | 3 | – | 4 | – | 7 | 9 |"
    assert lines[4] == "| a | pycolmap, 9 images | 100.0 | – | 3 | – | 4 | – | 7 | 9 |"
    assert lines[5].startswith("| b | not available, x | –")
    assert poses_from_color.tabulate_poses_from_color([]) == []


def test_what_moved_is_reported_by_figure() -> None:
    def results(**figures: Any) -> dict[str, Any]:
        return {"rows": [{"capture": "a", "variant": "rgbd", **figures}, {"capture": "a", "variant": "x"}]}

    said = describe_moves(
        results(iou=0.50, ate_rmse_m=0.0100, miou=None), results(iou=0.52, ate_rmse_m=0.0101, miou=0.3)
    )
    assert said.splitlines() == ["a rgbd: IoU 50.00 -> 52.00 (+2.00)", "a rgbd: mIoU – -> 30.00"]
    one = {"rows": results()["rows"][:1]}
    assert describe_moves(results(), one) == "a x: not measured this time"
    assert describe_moves(one, results()) == "a x: new"


def test_a_figure_that_was_not_measured_is_never_a_zero() -> None:
    rows = [
        {"capture": "a", "variant": "x", "title": "X", "available": False, "why": "needs a network"},
        {"capture": "a", "variant": "y", "title": "Y", "available": True, "why": "", "iou": 0.0, "miou": None},
    ]
    lines = write_markdown(
        {"rows": rows, "measurements": {"splat": [{"capture": "", "error": "no compiler"}]}}
    ).splitlines()
    assert lines[2].split(" | ")[2:12] == ["–"] * 10
    assert lines[3].split(" | ")[3:5] == ["0.0", "–"]
    assert lines[-1] == "splat: not available, no compiler"


def test_the_ablations_of_the_paper_are_there_by_name() -> None:
    known = read_ablations()
    runs = {name for name, variant in known.items() if not variant.lacking}
    assert {"rgbd", "rgbd_true_poses", "rgbd_closed_set", "rgbd_true_poses_closed_set"} <= runs
    for kind in ("rgbd", "mono"):
        for part in ("", "_no_initialization", "_no_anchoring_no_initialization"):
            assert kind + part in known
    assert {"mono_mast3r_slam", "mono_vggt_slam", "mono_seem", "mono_dinov2"} <= set(known)
    for variant in known.values():
        assert "\n" not in variant.lacking
        # A variant that cannot run says so in words of its own: a misspelled key of one that could would show here.
        assert variant.lacking == "" or variant.lacking.startswith("needs ")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--variants", "rgdb"), "unknown variants rgdb"),
        (
            ("--variants", "rgbd_no_initialisation", "--frames", "2"),
            "'rgbd_no_initialisation' is now called 'rgbd_no_initialization'",
        ),
        (("--captures", "/nowhere"), "there is no capture /nowhere"),
        (("--captures", ".", "--frames", "2"), "at least 3"),
    ],
)
def test_mistakes_are_reported(arguments: tuple[str, ...], said: str) -> None:
    assert said in run_benchmark(*arguments, code=2)
