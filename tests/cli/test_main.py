"""The command line: exit codes, one sentence for each mistake, JSON and nothing else on stdout."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers import data_folder, write_scannet, write_seven_scenes

ROOT = Path(__file__).parents[2]
SMALL = ["--set", "capture.stop=8", "--set", "capture.synthetic.width=160", "--set", "capture.synthetic.height=120"]


def run(
    *arguments: object, code: int = 0, lines: str = "", encoding: str | None = None
) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-m", "freeocc3d.cli", *map(str, arguments)],
        input=lines,
        capture_output=True,
        text=True,
        errors="surrogateescape",
        timeout=300,
        env=os.environ | ({"PYTHONIOENCODING": encoding} if encoding else {}),
    )
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def refused(*arguments: object) -> str:
    """The one line on stderr with which a command is refused."""
    done = run(*arguments, code=1)
    lines = [line for line in done.stderr.splitlines() if line.startswith("freeocc3d: ")]
    assert len(lines) == 1, done.stderr
    assert done.stdout == ""
    return lines[0]


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("cli") / "room"
    done = run("reconstruct", "builtin:room", "-o", path, *SMALL)
    assert "8 with a pose" in done.stdout
    return path


def test_query_json(room) -> None:
    document = json.loads(run("query", room, "red cup", "unicorn", "--json").stdout)
    assert document["results"][0]["matched"]
    assert document["results"][0]["understood"] == "red"
    assert document["results"][1] == {
        "word": "unicorn", "matched": False, "understood": "", "regions": [],
        "note": document["results"][1]["note"],
    }  # fmt: skip


def test_query_json_says_how_regions_stand_and_on_request_which_keyframes_show_them(room) -> None:
    plain = json.loads(run("query", room, "red", "--json").stdout)["results"][0]["regions"]
    seen = json.loads(run("query", room, "red", "--json", "--views").stdout)["results"][0]["regions"]
    assert plain[0]["label"] == "red"
    assert set(plain[0]["oriented_box"]) == {"extent", "yaw", "T_map_box"}
    assert set(seen[0]) - set(plain[0]) == {"keyframes", "stand"}
    assert 0 < len(seen[0]["keyframes"]) <= 3
    x0, y0, x1, y1 = seen[0]["keyframes"][0]["box"]
    assert 0 <= x0 < x1 < 160
    assert 0 <= y0 < y1 < 120
    assert "--json" in run("query", room, "red", "--views", code=2).stderr


def test_query_with_conditions_on_places(room) -> None:
    def corners(*arguments: object) -> list[list[float]]:
        document = json.loads(run("query", room, *arguments, "--json").stdout)
        return [region["box_min"] for region in document["results"][0]["regions"]]

    every = corners("red")
    assert len(every) > 1
    assert len(corners("red", "--pick", "largest")) == 1
    assert corners("red", "--within", -99, -99, -99, 99, 99, 99, "--near", "white:99") == every
    assert "none is on 'unicorn'" in run("query", room, "red", "--on", "unicorn").stdout
    assert "excluded" in refused("query", room, "red", "--not", "red")
    assert "lies outside" in refused("query", room, "red", "--within", 98, 98, 98, 99, 99, 99)
    assert "largest, highest" in refused("query", room, "red", "--pick", "nicest")


def test_interactive_answers_every_line_and_survives_what_it_cannot_answer(room) -> None:
    lines = "red\n\nred cup, unicorn\n" + "x" * 300 + "\nyellow"
    told = run("query", room, "--interactive", "--json", lines=lines)
    first, second, third, fourth = (json.loads(line) for line in told.stdout.splitlines())
    assert first == json.loads(run("query", room, "red", "--json").stdout)
    assert [result["word"] for result in second["results"]] == ["red cup", "unicorn"]
    assert "300 characters" in third["error"]
    assert fourth["results"][0]["matched"]
    table = run("query", room, "--interactive", "--pick", "best", lines=lines)
    assert "red: 1 region" in table.stdout
    assert "yellow: 1 region" in table.stdout
    assert "300 characters" in table.stderr
    assert run("query", room, "--interactive", lines="").stdout == ""
    for wrong in (["--interactive", "red"], [], ["--interactive", "--picture", "x.png"]):
        assert run("query", room, *wrong, code=2).stdout == ""


def test_query_text_ply_and_picture(room, tmp_path) -> None:
    done = run("query", room, "yellow", "--top", 1, "--ply", tmp_path / "q.ply", "--picture", tmp_path / "q.png")
    assert "yellow: 1 region" in done.stdout
    assert (tmp_path / "q.ply").read_bytes().startswith(b"ply\n")
    assert (tmp_path / "q.png").read_bytes().startswith(b"\x89PNG")
    before = (room / "gaussians.ply").read_bytes()
    assert "--overwrite" in refused("query", room, "yellow", "--ply", room / "gaussians.ply")
    assert (room / "gaussians.ply").read_bytes() == before
    run("view", room, "--picture", tmp_path / "q.png", "--overwrite")


def test_query_by_class_by_picture_and_as_a_page(room, tmp_path) -> None:
    names = run("query", room, "--classes").stdout.split()
    assert "yellow" in names
    looks = sorted((room / "keyframes").glob("*.color.jpg"))[0]
    asked = ["yellow", "--class", "yellow", "--image", looks, "--box", 0, 0, 20, 20]
    done = run("query", room, *asked, "--json", "--html", tmp_path / "q.html", "--top", 3)
    word, of_class, alike = json.loads(done.stdout)["results"]
    assert (word["word"], of_class["word"], alike["word"]) == ("yellow", "yellow", looks.name)
    assert of_class["regions"][0]["voxels"] >= word["regions"][0]["voxels"]
    assert len(alike["regions"]) <= 3
    assert (tmp_path / "q.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert "did you mean 'yellow'?): --classes" in refused("query", room, "--class", "yelow")
    assert "does not lie in the picture" in refused("query", room, "--image", looks, "--box", 5, 0, 4, 9)
    assert "is not a picture" in refused("query", room, "--image", room / "map.yaml")
    for wrong in (
        ["red", "--box", 0, 0, 1, 1],
        ["--class", "red", "--not", "blue"],
        ["--interactive", "--class", "red"],
    ):
        assert run("query", room, *wrong, code=2).stdout == ""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--threshold", "nan"], "'threshold'"),
        (["--within", 0, 0, 0, 1, 1, "inf"], "'within'"),
        (["--near", "blue:nan"], "'near'"),
        (["--refine", "nan"], "nan"),
        (["--top", 0], "'top_k'"),
    ],
)
def test_a_query_with_impossible_numbers_is_refused(room, arguments, said) -> None:
    assert said in refused("query", room, "red", *arguments)


@pytest.mark.parametrize("option", ["--ply", "--picture", "--html"])
def test_a_query_tells_of_an_unusable_target_before_it_answers(room, tmp_path, option) -> None:
    kept = tmp_path / "kept.png"
    kept.write_bytes(b"mine")
    assert "exists: choose another name, or replace it with --overwrite" in refused("query", room, "red", option, kept)
    assert kept.read_bytes() == b"mine"
    assert "there is no folder" in refused("query", room, "red", option, tmp_path / "none" / "q.png")
    assert "is a folder" in refused("query", room, "red", option, tmp_path, "--overwrite")


def test_one_file_is_not_asked_for_twice(room, tmp_path) -> None:
    same = tmp_path / "answer.png"
    assert "another name" in run("query", room, "red", "--picture", same, "--html", same, code=2).stderr
    assert not same.exists()


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


def test_export_and_view(room, tmp_path) -> None:
    run("export", room, "--format", "npz", "-o", tmp_path / "m.npz")
    run("export", room, "--format", "ply", "-o", tmp_path / "m.ply", "--set", "form=points")
    run("view", room, "--picture", tmp_path / "m.png", "--by", "class")
    assert {p.name for p in tmp_path.iterdir()} == {"m.npz", "m.ply", "m.png"}
    assert "--overwrite" in refused("export", room, "--format", "npz", "-o", tmp_path / "m.npz")
    assert "did you mean 'npz'" in refused("export", room, "--format", "npzz", "-o", tmp_path / "x")
    for name in ("m.bt", "m.ot", "m.yaml", "m.vdb", "m.glb", "m.geojson", "poses"):
        kind = {"m.bt": "octomap", "m.ot": "octomap", "m.yaml": "nav2", "m.vdb": "esdf"}.get(name, name.split(".")[-1])
        told = run("export", room, "--format", kind, "--frame", "first-camera", "-o", tmp_path / name)
        assert int(told.stdout.split(": ")[1].split()[0].replace(",", "")) > 100
    assert "gravity or first-camera" in refused(
        "export", room, "--format", "npz", "--frame", "up", "-o", tmp_path / "x"
    )


def test_words_of_an_export_may_be_given_plainly(room, tmp_path) -> None:
    out, red = tmp_path / "m.yaml", ("export", room, "--format", "nav2", "-o", tmp_path / "m.yaml", "--set")
    assert run(*red, "avoid=red, white:0.3:50%").stderr == ""
    assert {p.name for p in tmp_path.iterdir()} >= {"m.red.yaml", "m.white.pgm", "m.avoid.yaml"}
    told = run(*red, "avoid=[orange]", "--overwrite").stderr
    assert told.startswith("warning: Nothing in this map looks like 'orange'")
    run("export", room, "--format", "npz", "-o", tmp_path / "b.npz", "--set", "box=-0.5, -0.5, 1, 0.5, 0.5, 4")
    with np.load(tmp_path / "b.npz") as part:
        assert max(part["occupancy"].shape[:2]) <= 13  # 1 m of voxels of 8 cm
    before = out.read_bytes()
    assert "'avoid' is no YAML" in refused(*red, "avoid=[red", "--overwrite")
    assert "'carpet' is not understood" in refused(*red, "avoid=carpet", "--overwrite")
    assert out.read_bytes() == before


def test_list_names_every_backend_without_importing_them() -> None:
    text = run("list").stdout
    for name in ("seven_scenes", "replica", "scannet", "synthetic", "rgbd", "known", "colour", "labels", "npz", "ply"):
        assert f"  {name} " in text
    assert "encoder" in json.loads(run("list", "--json").stdout)
    exporters = run("list", "exporters").stdout
    assert exporters == run("list", "export").stdout
    assert "min_height = 0.1  (float) Metres above the floor" in exporters
    assert "rgbd" not in exporters
    assert list(json.loads(run("list", "trackers", "--json").stdout)) == ["tracker"]


def test_the_tools_are_the_same_commands(room) -> None:
    for tool, arguments in (("query", [room, "red", "--json"]), ("reconstruct", ["--help"]), ("export", ["--help"])):
        done = subprocess.run(
            [sys.executable, ROOT / "tools" / f"{tool}.py", *map(str, arguments)], capture_output=True, timeout=120
        )
        assert done.returncode == 0


def test_mistakes_with_captures(tmp_path) -> None:
    out = tmp_path / "map"
    assert "There is no folder" in refused("reconstruct", tmp_path / "nothing", "-o", out)
    (tmp_path / "empty").mkdir()
    message = refused("reconstruct", tmp_path / "empty", "-o", out)
    assert "frame-" in message
    assert "traj.txt" in message or "results/" in message
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
    assert "must be float" in refused("reconstruct", "builtin:room", "-o", out, "--set", "occupancy.voxel_size=big")
    (tmp_path / "c.yaml").write_text("tracking: {backend: rgbd\n")
    assert "not valid YAML" in refused("reconstruct", "builtin:room", "-o", out, "--config", tmp_path / "c.yaml")
    assert "--overwrite" in refused("reconstruct", "builtin:room", "-o", room)
    cuda = refused("reconstruct", "builtin:room", "-o", out, *SMALL, "--device", "cuda:7")
    assert "Nothing that is chosen runs on cuda:7" in cuda
    odometry = ("--set", "tracking.backend=odometry", "--device", "cuda:7")
    assert "There is no device 'cuda:7'" in refused("reconstruct", "builtin:room", "-o", out, *SMALL, *odometry)
    assert list(tmp_path.iterdir()) == [tmp_path / "c.yaml"]


def test_mistakes_with_maps(tmp_path) -> None:
    assert "There is no map folder" in refused("query", tmp_path / "nothing", "red")
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


def test_ctrl_c_ends_cleanly_and_resumes(tmp_path) -> None:
    out = tmp_path / "map"
    command = [
        sys.executable,
        "-m",
        "freeocc3d.cli",
        "reconstruct",
        str(data_folder() / "7scenes-kitchen"),
        "-o",
        str(out),
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    while not (Path(f"{out}.partial") / "stages.json").exists():  # the first checkpoint
        assert process.poll() is None
        os.sched_yield()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
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
