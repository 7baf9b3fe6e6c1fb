"""``freeocc3d query``: words, conditions, pictures, files, lines of input."""

import json

import numpy as np
import pytest
from command_line import refused, run


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


def test_places_in_the_first_cameras_frame(room) -> None:
    """Boxes there hold the same voxels, and are level no more; centroids move as the manifest says."""
    told = run("info", room, "--json").stdout
    T = np.array(json.loads(told)["T_first_camera"])
    own, first = (
        json.loads(run("query", room, "red", "--json", "--frame", frame).stdout) for frame in ("map", "first-camera")
    )
    assert (own["frame"], first["frame"]) == ("map", "first-camera")
    np.testing.assert_allclose(first["T_frame_map"], T, atol=1e-6)
    for here, there in zip(own["results"][0]["regions"], first["results"][0]["regions"], strict=True):
        np.testing.assert_allclose(T[:3, :3] @ here["centroid"] + T[:3, 3], there["centroid"], atol=2e-4)
        assert (np.array(there["box_min"]) < there["centroid"]).all()
        assert (np.array(there["box_max"]) > there["centroid"]).all()
        assert here["oriented_box"] == there["oriented_box"]
    assert first["results"][0]["regions"][0]["centroid"] != own["results"][0]["regions"][0]["centroid"]
    assert run("query", room, "red", "--frame", "start").stdout != run("query", room, "red").stdout
    assert "start or first-camera" in refused("query", room, "red", "--frame", "robot")


def test_query_with_conditions_on_places(room) -> None:
    def corners(*arguments: object) -> list[list[float]]:
        document = json.loads(run("query", room, *arguments, "--json").stdout)
        return [region["box_min"] for region in document["results"][0]["regions"]]

    every = corners("yellow")
    assert len(every) > 1
    assert len(corners("yellow", "--pick", "largest")) == 1
    assert corners("yellow", "--within", -99, -99, -99, 99, 99, 99, "--near", "white:99") == every
    assert "none is on 'unicorn'" in run("query", room, "yellow", "--on", "unicorn").stdout
    assert "excluded" in refused("query", room, "yellow", "--not", "yellow")
    assert "exclude the rest with --not WORD" in refused("query", room, "not yellow")
    assert corners("a photo of a yellow thing.") == every
    assert "lies outside" in refused("query", room, "yellow", "--within", 98, 98, 98, 99, 99, 99)
    assert "largest, highest" in refused("query", room, "yellow", "--pick", "nicest")


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
    assert "must end in .ply, got 'q.splat'" in refused("query", room, "yellow", "--ply", tmp_path / "q.splat")
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
    assert "is not a readable image" in refused("query", room, "--image", room / "map.yaml")
    for wrong in (
        ["red", "--box", 0, 0, 1, 1],
        ["--class", "red", "--not", "blue"],
        ["--interactive", "--class", "red"],
    ):
        assert run("query", room, *wrong, code=2).stdout == ""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--within", 0, 0, 0, 1, 1, "inf"], "'within'"),
        (["--within", 0, 0, 0, 1, 1, 1e7], "at most 1e+06 m from the origin"),
        (["--near", "blue:nan"], "'near'"),
        (["--near", "blue:1e7"], "0 to 1e+06 meters"),
        (["--refine", "nan"], "nan"),
    ],
)
def test_a_query_with_impossible_numbers_is_refused(room, arguments, said) -> None:
    assert said in refused("query", room, "red", *arguments)


@pytest.mark.parametrize(("option", "value"), [("--threshold", "nan"), ("--threshold", 2), ("--top", 0)])
def test_a_number_outside_its_range_is_wrong_usage_and_its_option_is_named(room, option, value) -> None:
    assert f"Invalid value for '{option}'" in run("query", room, "red", option, value, code=2).stderr


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
    assert "different file names" in run("query", room, "red", "--picture", same, "--html", same, code=2).stderr
    assert not same.exists()
