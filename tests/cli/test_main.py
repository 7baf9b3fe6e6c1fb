"""The command line: exit codes, one sentence for each mistake, JSON and nothing else on stdout."""

import contextlib
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import SMALL, refused, run
from small_captures import data_folder, write_scannet, write_seven_scenes

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("encoding", ["ascii", "utf-8:strict"])
def test_words_that_a_terminal_cannot_show_are_answered(room, encoding) -> None:
    assert "no match" in run("query", room, "\udcff", "диван", encoding=encoding).stdout
    assert "\nred: " in run("query", room, "--interactive", lines="\udcff\nred", encoding=encoding).stdout


def test_info_json_has_the_documented_keys(room) -> None:
    facts = json.loads(run("info", room, "--json").stdout)
    assert set(facts) >= {
        "version", "frames", "frames_with_pose", "submaps", "gaussians", "voxels", "voxel_size_m", "encoder", "bytes",
        "seconds", "peak_memory_bytes",
    }  # fmt: skip
    assert set(facts["voxels"]) >= {"occupied", "free"}
    assert facts["frames_with_pose"] == 8


def test_list_names_every_backend_without_importing_them() -> None:
    text = run("list").stdout
    for name in ("seven_scenes", "replica", "scannet", "synthetic", "rgbd", "known", "color", "labels", "npz", "ply"):
        assert f"  {name} " in text
    assert "encoder" in json.loads(run("list", "--json").stdout)
    exporters = run("list", "exporters").stdout
    assert exporters == run("list", "export").stdout
    assert "min_height = 0.1  (a number from -1000 to 1000) Least height of an obstacle above the floor" in exporters
    assert "rgbd" not in exporters
    assert list(json.loads(run("list", "trackers", "--json").stdout)) == ["tracker"]


def test_the_tools_are_the_same_commands(room) -> None:
    for tool in ("reconstruct", "query", "export", "evaluate", "view", "ground_truth"):
        source = (ROOT / "tools" / f"{tool}.py").read_text()
        assert f'main(["{tool.replace("_", "-")}", *sys.argv[1:]])' in source
    command = [sys.executable, str(ROOT / "tools" / "query.py"), str(room), "red", "--json"]
    done = subprocess.run(command, capture_output=True, timeout=120, check=True)
    assert json.loads(done.stdout)["results"][0]["word"] == "red"


def test_mistakes_with_captures(tmp_path) -> None:
    out = tmp_path / "map"
    assert "There is no folder" in refused("reconstruct", tmp_path / "nothing", "-o", out)
    (tmp_path / "empty").mkdir()
    message = refused("reconstruct", tmp_path / "empty", "-o", out)
    assert "not a capture of a known format" in message
    assert "freeocc3d list" in message
    scan = write_scannet(tmp_path / "scan", 4)
    (scan / "intrinsic" / "intrinsic_depth.txt").write_text("nan 0 16 0\n0 500 12 0\n0 0 1 0\n0 0 0 1\n")
    assert "intrinsic_depth.txt" in refused("reconstruct", scan, "-o", out)
    nodepth = write_seven_scenes(tmp_path / "nodepth", 3)
    for path in nodepth.glob("*.depth.png"):
        path.unlink()
    assert "depth" in refused("reconstruct", nodepth, "-o", out)
    assert not out.exists()
    assert not Path(f"{out}.partial").exists()


def test_mistakes_with_configurations_and_outputs(tmp_path, room) -> None:
    out = tmp_path / "map"
    assert "did you mean 'voxel_size'" in refused(
        "reconstruct", "builtin:room", "-o", out, "--set", "occupancy.voxelsize=0.1"
    )
    assert "must be a number from 0.001 to 100" in refused(
        "reconstruct", "builtin:room", "-o", out, "--set", "occupancy.voxel_size=big"
    )
    (tmp_path / "c.yaml").write_text("tracking: {backend: rgbd\n")
    assert "not valid YAML" in refused("reconstruct", "builtin:room", "-o", out, "--config", tmp_path / "c.yaml")
    assert "--overwrite" in refused("reconstruct", "builtin:room", "-o", room)
    cuda = refused("reconstruct", "builtin:room", "-o", out, *SMALL, "--device", "cuda:7")
    assert "No chosen backend runs on cuda:7" in cuda
    odometry = ("--set", "tracking.backend=odometry", "--device", "cuda:7")
    assert "There is no device 'cuda:7'" in refused("reconstruct", "builtin:room", "-o", out, *SMALL, *odometry)
    assert list(tmp_path.iterdir()) == [tmp_path / "c.yaml"]


@pytest.mark.parametrize(
    "command",
    [
        [], ["demo"], ["reconstruct"], ["query"], ["view"], ["info"], ["check"], ["export"], ["refine"], ["scale"],
        ["upright"], ["evaluate"], ["ground-truth"], ["list"], ["models"], ["models", "pull"], ["models", "export"],
        ["models", "list"], ["models", "verify"],
    ],
    ids=" ".join,
)  # fmt: skip
def test_every_help_page_explains_every_option(command: list[str]) -> None:
    from typer.main import get_command

    from freeocc3d.cli.main import app

    found: Any = get_command(app)
    for name in command:
        found = found.commands[name]
    assert found.help
    for parameter in found.params:
        assert parameter.help.endswith((".", "]")), parameter.name
        assert "[default" not in parameter.help  # a terminal takes that for markup and leaves it out
    assert "Usage: freeocc3d" in run(*command, "--help").stdout


def test_the_demo_thins_the_walk_and_answers_its_words(tmp_path) -> None:
    """That it compiles nothing that was compiled ahead, ``make wheel-test`` sees."""
    out = tmp_path / "demo"
    told = run("demo", "-o", out, "--frames", 12).stdout
    assert "12 in the capture, 12 used" in told
    assert "blue chair: " in told
    assert "blue chair: no match" not in told
    assert "bathtub: no match. 'bathtub' is not understood" in told
    assert f"freeocc3d relabel {out / 'map'} -o " in told
    assert {path.name for path in out.iterdir()} == {
        "map", "map.png", "query_red_cup.png", "query_blue_chair.png", "query_something_to_sit_on.png"
    }  # fmt: skip
    assert "2" in run("demo", "-o", out, "--frames", 1, code=2).stderr


def test_mistakes_with_maps(tmp_path) -> None:
    assert "nothing does not exist" in refused("query", tmp_path / "nothing", "red")
    assert "not a map" in refused("info", tmp_path)
    assert run("query", code=2).stdout == ""


def test_debug_shows_the_traceback(tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "freeocc3d.cli", "info", tmp_path, "--debug"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "Traceback" in done.stderr


def test_a_stopped_run_ends_cleanly_and_resumes(tmp_path) -> None:
    out = tmp_path / "map"
    command = [
        sys.executable,
        "-m",
        "freeocc3d.cli",
        "reconstruct",
        str(data_folder() / "7scenes-kitchen"),
        "-o",
        str(out),
        "--set",
        "capture.color_focal=1",
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    while not (Path(f"{out}.partial") / "stages.json").exists():  # the first checkpoint
        with contextlib.suppress(subprocess.TimeoutExpired):
            pytest.fail(f"ended with {process.wait(0.05)}")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 143
    assert "--resume" in errors
    assert "Traceback" not in errors
    assert not out.exists()
    assert "--resume" in refused("reconstruct", data_folder() / "7scenes-kitchen", "-o", out)


def test_info_shows_what_a_model_named(room, tmp_path) -> None:
    path = shutil.copytree(room, tmp_path / "map")
    assert json.loads(run("info", path, "--json").stdout)["vocabulary"] is None
    assert "words" not in run("info", path).stdout
    names = {f"thing {chr(97 + n)}": {"count": 20 - n, "keyframes": list(range(20 - n))} for n in range(13)}
    manifest = yaml.safe_load((path / "map.yaml").read_text())
    manifest["vocabulary"] = {"model": "a-model", "keyframes": list(range(20)), "names": names}
    (path / "map.yaml").write_text(yaml.safe_dump(manifest, sort_keys=False))
    shown = run("info", path).stdout
    assert "words      13 named by a-model in 20 keyframes: thing a 20, thing b 19" in shown
    assert "thing l 9, …" in shown
    assert json.loads(run("info", path, "--json").stdout)["vocabulary"]["names"]["thing m"]["count"] == 8
