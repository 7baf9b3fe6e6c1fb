"""The server of the viewer answers its own page about its own maps, and nothing else."""

from __future__ import annotations

import gzip
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from labeled_rooms import labeled_room
from starlette.testclient import TestClient
from test_packets import unpack

import freeocc3d
from freeocc3d.core.errors import FreeOccError, MapError
from freeocc3d.query.scan_map import Map
from freeocc3d.viewer.browser import page, shown_map
from freeocc3d.viewer.browser.server import make_app
from freeocc3d.viewer.browser.serving import serve_maps
from freeocc3d.viewer.browser.shown_map import ShownMap

LOCAL = "http://localhost:8080"


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return labeled_room(tmp_path_factory)


@pytest.fixture(scope="module")
def client(room: Map) -> Iterator[TestClient]:
    with TestClient(make_app([ShownMap(room.path)]), base_url=LOCAL) as opened:
        yield opened


def ask(client: TestClient, **question: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    answered = client.post("/maps/0/query", json=question)
    assert answered.status_code == 200, answered.text
    return unpack(answered.content)


def test_the_page_and_its_parts_are_served(client: TestClient) -> None:
    shown = client.get("/")
    assert shown.status_code == 200
    assert "frame-ancestors 'self'" in shown.headers["content-security-policy"]
    for script in page._SCRIPTS:
        assert client.get(f"/parts/{script}.js").headers["content-type"].startswith("text/javascript")
    assert client.get("/parts/style.css").status_code == 200
    assert client.get("/maps").json() == [{"name": "labeled-room", "capture": "builtin:room"}]


def test_answers_are_those_of_the_map(client: TestClient, room: Map) -> None:
    meta, arrays = ask(client, words=["table", "bathtub"])
    expected = room.query_words(["table", "bathtub"], top_k=200)
    assert [result["word"] for result in meta["results"]] == ["table", "bathtub"]
    assert [len(result["regions"]) for result in meta["results"]] == [len(result.regions) for result in expected]
    assert meta["results"][1]["note"] == expected[1].note
    assert meta["results"][0]["color"] != meta["results"][1]["color"]
    first = expected[0].regions[0]
    assert arrays["rows"][: first.voxels].tolist() == first.rows.tolist()
    assert meta["results"][0]["regions"][0]["score"] == pytest.approx(first.score, abs=1e-4)
    views = client.post("/maps/0/views", json={"answer": meta["answer"], "region": 0}).json()
    assert [view["frame"] for view in views] == [view.frame for view in room.views_of(first)]
    assert [tuple(view["box"]) for view in views] == [view.box for view in room.views_of(first)]


def test_conditions_apply(client: TestClient, room: Map) -> None:
    box = [*(room.query("table").regions[0].box_min - 0.1), *(room.query("table").regions[0].box_max + 0.1)]
    inside, _ = ask(client, words=["table"], within=[float(value) for value in box])
    corner = room.query("wall").regions[0].box_max
    outside, _ = ask(client, words=["table"], within=[*(corner - 0.1).tolist(), *(corner + 0.1).tolist()])
    assert inside["results"][0]["regions"]
    assert not outside["results"][0]["regions"]
    assert "none is within" in outside["results"][0]["note"]
    of_class, _ = ask(client, classes=["wall"])
    assert of_class["results"][0]["regions"]


def test_a_voxel_tells_of_itself(client: TestClient, room: Map) -> None:
    row = int(room.query("table").regions[0].rows[0])
    told = client.post("/maps/0/voxel", json={"row": row}).json()
    occupancy = room.occupancy
    assert told["center"] == pytest.approx(occupancy.centers(occupancy.occupied_voxels())[row].tolist())
    assert told["words"][0]["word"] == room.vocabulary[room.labels()[row] - 1]
    for view in told["views"]:
        depth = room.keyframes.depth_m(view["keyframe"])[view["pixel"][1], view["pixel"][0]]
        assert depth > 0


def test_photographs_are_those_of_the_keyframes(client: TestClient, room: Map) -> None:
    answered = client.get("/maps/0/keyframes/0.jpg")
    assert answered.content == room.keyframes.views()[0][0].read_bytes()
    assert client.get("/maps/0/keyframes/999.jpg").status_code == 422


@pytest.mark.parametrize(
    ("address", "status"),
    [
        ("/maps/7/scene", 404), ("/maps/-1/scene", 404), ("/parts/server.py", 404), ("/parts/..%2Fserver.py", 404),
        ("/parts/%2e%2e/%2e%2e/setup.cfg", 404), ("/maps/0/keyframes/../map.yaml", 404), ("/map.yaml", 404),
        ("/maps/0/keyframes/1e9.jpg", 404), ("/maps/0/query", 405),
    ],
)  # fmt: skip
def test_nothing_else_is_served(client: TestClient, address: str, status: int) -> None:
    assert client.get(address).status_code == status


@pytest.mark.parametrize(
    ("body", "kind", "status"),
    [
        (b"{", "application/json", 400), (b'{"words": 3}', "application/json", 400), (b"{}", "text/plain", 415),
        (b'{"words": ["' + b"a" * 201 + b'"]}', "application/json", 400), (b'{"x": 1}', "application/json", 400),
        (b'{"words": [' + b'"a",' * 30000 + b'"a"]}', "application/json", 413), (b"\xff\xfe", "application/json", 400),
        (b'{"within": [0, 0, 0, 1, 1]}', "application/json", 400), (b"[" * 60000, "application/json", 400),
        (b'{"words": [""]}', "application/json", 400), (b'{"words": ["not red"]}', "application/json", 422),
        (b'{"words": ["a"], "within": [1, 0, 0, 0, 1, 1]}', "application/json", 422),
        (b'{"classes": ["no such class"]}', "application/json", 422),
    ],
)  # fmt: skip
def test_bad_questions_get_a_sentence(client: TestClient, body: bytes, kind: str, status: int) -> None:
    answered = client.post("/maps/0/query", content=body, headers={"Content-Type": kind})
    assert answered.status_code == status
    assert answered.json()["error"].endswith(".")


def test_only_names_of_this_machine_and_its_own_page_are_answered(client: TestClient) -> None:
    for headers in ({"Host": "evil.example"}, {"Host": "localhost.evil.example:8080"}, {"Origin": "http://evil.example"},
                    {"Origin": "null"}, {"Host": ""}):  # fmt: skip
        assert client.get("/maps", headers=headers).status_code == 403, headers
    for headers in ({"Host": "127.0.0.1:8080"}, {"Host": "[::1]:8080"}, {"Origin": LOCAL}):
        assert client.get("/maps", headers=headers).status_code == 200, headers


def test_elsewhere_each_address_needs_the_token(room: Map) -> None:
    with TestClient(make_app([ShownMap(room.path)], token="secret", local=False), base_url="http://robot") as client:
        for path in ("/", "/maps", "/secre/maps", "/secrets/maps", "/maps/0/keyframes/0.jpg", "/secret"):
            refused = client.get(path)
            assert (refused.status_code, "token" in refused.json()["error"]) == (403, True), path
        assert client.get("/secret/").status_code == client.get("/secret/maps").status_code == 200
        assert client.post("/secret/maps/0/query", json={"words": ["table"]}).status_code == 200


def test_a_map_that_is_replaced_is_read_again(room: Map, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    shutil.copytree(room.path, folder)
    with TestClient(make_app([ShownMap(folder)]), base_url=LOCAL) as client:
        before = client.get("/maps/0/state").json()["version"]
        answer, _ = ask(client, words=["table"])
        settings = {"capture": {"stop": 4, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}},
                    "tracking": {"backend": "known"}, "fitting": {"passes": 0}}  # fmt: skip
        other = freeocc3d.reconstruct("builtin:room", tmp_path / "other", settings)
        shutil.rmtree(folder)
        gone = client.get("/maps/0/scene")
        assert (gone.status_code, str(folder) in gone.json()["error"]) == (422, True)
        shutil.copytree(other.path, folder)
        assert client.get("/maps/0/state").json()["version"] != before
        arrays = unpack(client.get("/maps/0/scene").content)[1]
        assert len(arrays["voxels"]) == len(other.occupancy.colors)
        old = client.post("/maps/0/views", json={"answer": answer["answer"], "region": 0})
        assert (old.status_code, old.json()) == (410, {"error": "The answer is no longer kept: ask again."})
        (folder / "occupancy.npz").write_bytes(b"short")
    with pytest.raises(MapError, match="occupancy"):
        ShownMap(folder)


def test_folders_and_ports_that_cannot_be_used_are_refused(room: Map, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="does not exist"):
        serve_maps([tmp_path / "none"])
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(FreeOccError, match="is taken: choose another --port"):
            serve_maps([room.path], port=taken.getsockname()[1])
    with pytest.raises(FreeOccError, match=r"Cannot listen on no\.such\.host\.invalid"):
        serve_maps([room.path], host="no.such.host.invalid")


def test_packets_are_compressed(client: TestClient) -> None:
    with client.stream("GET", "/maps/0/space") as answered:
        assert unpack(gzip.decompress(b"".join(answered.iter_raw())))[1]["free"].shape[1] == 4


def test_a_map_that_is_replaced_while_it_is_packed_is_packed_again(
    room: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"capture": {"stop": 4, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}},
                "tracking": {"backend": "known"}, "fitting": {"passes": 0}}  # fmt: skip
    other = freeocc3d.reconstruct("builtin:room", tmp_path / "other", settings)
    folder = shutil.copytree(room.path, tmp_path / "map")
    shown, describe = ShownMap(folder), shown_map.describe_scene

    def describe_and_replace(scan_map: Map) -> Any:
        described = describe(scan_map)
        if not (tmp_path / "old").exists():
            folder.rename(tmp_path / "old")
            shutil.copytree(other.path, folder)
        return described

    monkeypatch.setattr(shown_map, "describe_scene", describe_and_replace)
    meta, arrays = unpack(gzip.decompress(shown.scene()))
    assert (len(arrays["voxels"]), meta["version"]) == (len(other.occupancy.colors), shown.version)
