"""``freeocc3d objects``: its table, its document, its page and its picture."""

import json
from pathlib import Path

import cv2
import numpy as np
from command_line import refused, run

from freeocc3d.query.scan_map import load_map
from freeocc3d.viewer.object_pictures import SIZE

KEYS = {
    "number", "name", "names", "confidence", "centroid", "oriented_box", "volume_m3", "voxels", "keyframes",
    "relations",
}  # fmt: skip


def test_the_document_and_the_table_tell_of_the_same_objects(room: Path, tmp_path: Path) -> None:
    page, picture = tmp_path / "o.html", tmp_path / "o.png"
    document = json.loads(run("objects", room, "--json", "--html", page, "--picture", picture).stdout)
    assert (document["map"], document["metric"], document["frame"]) == (str(room), True, "map")
    listed = document["objects"]
    assert [thing["number"] for thing in listed] == list(range(1, len(listed) + 1))
    loaded = load_map(room)
    frames = set(loaded.trajectory.keyframes.tolist())
    for thing, found in zip(listed, loaded.objects(), strict=True):
        assert set(thing) == KEYS
        assert thing["voxels"] == len(found.rows)
        np.testing.assert_allclose(thing["centroid"], found.centroid, atol=1e-4)
        np.testing.assert_allclose(thing["oriented_box"]["T_map_box"], found.box.T_map_box, atol=1e-6)
        assert {view["frame"] for view in thing["keyframes"]} <= frames
        assert all(own["other"] is None or own["other"] <= len(listed) for own in thing["relations"])
    assert page.read_text(encoding="utf-8").count("<figure id=") == len(listed)
    assert cv2.imread(str(picture)).shape == (SIZE[1], SIZE[0], 3)
    name = listed[-1]["name"]  # the table of some objects keeps their numbers
    lines = run("objects", room, "--class", name).stdout.splitlines()
    assert [line.split()[:2] for line in lines[2:]] == [
        [str(thing["number"]), name.split()[0]] for thing in listed if thing["name"] == name
    ]
    names = ", ".join(sorted({thing["name"] for thing in listed}))
    assert f"Its objects are: {names}." in refused("objects", room, "--class", "unicorn")


def test_a_query_answers_with_whole_objects_first(room: Path) -> None:
    objects = load_map(room).objects()
    word = objects[0].name
    regions = json.loads(run("query", room, word, "--objects", "--json").stdout)["results"][0]["regions"]
    numbers = [region["object"] for region in regions]
    things = [number for number in numbers if number is not None]
    assert things
    assert numbers == [*things, *[None] * (len(numbers) - len(things))]
    for region, number in zip(regions, things, strict=False):
        assert (region["name"], region["voxels"]) == (objects[number - 1].name, len(objects[number - 1].rows))
    count = f"{word}: {len(things)} object{'s' if len(things) > 1 else ''}"
    assert run("query", room, word, "--objects").stdout.startswith(count)


def test_unusable_targets_are_told_before_any_work(room: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept.png"
    kept.write_bytes(b"mine")
    assert "already exists" in refused("objects", room, "--html", kept)
    assert "there is no folder" in refused("objects", room, "--picture", tmp_path / "none" / "o.png")
    assert kept.read_bytes() == b"mine"
    assert "use the name" in refused("objects", room, "--picture", tmp_path / "o.jpg")
    assert "different file names" in run("objects", room, "--picture", kept, "--html", kept, code=2).stderr
