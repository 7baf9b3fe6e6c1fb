"""Each tool runs on a piece of a real scan."""

import json
import subprocess
import sys
from pathlib import Path

from small_captures import data_folder

TOOLS = Path(__file__).parents[2] / "tools"


def run(tool: str, *arguments: object) -> str:
    command = [sys.executable, str(TOOLS / f"{tool}.py"), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_reconstruct_query_export_and_view(tmp_path) -> None:
    kitchen = data_folder() / "7scenes-kitchen"
    run("reconstruct", kitchen, "-o", tmp_path / "map", "--set", "capture.stop=30", "--set", "capture.stride=3")
    document = json.loads(run("query", tmp_path / "map", "red", "--json"))
    assert document["results"][0]["matched"]  # the cupboards
    run("export", tmp_path / "map", "--format", "npz", "-o", tmp_path / "map.npz")
    run("view", tmp_path / "map", "--picture", tmp_path / "map.png")
    score = json.loads(run("evaluate", tmp_path / "map", "--json"))
    assert score["precision"] > 0.3
    assert score["miou"] is None
    run("ground_truth", kitchen, "-o", tmp_path / "gt.npz", "--set", "capture.stop=5")
    assert (tmp_path / "map.npz").stat().st_size > 0
    assert (tmp_path / "map.png").stat().st_size > 0
