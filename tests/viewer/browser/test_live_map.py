"""A map is shown while it is made: by snapshots that its run writes only if somebody watches."""

from __future__ import annotations

import errno
import gzip
import json
import os
import socket
import subprocess
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient
from test_packets import unpack

import freeocc3d
from freeocc3d.core.errors import MapError
from freeocc3d.core.types import Frame
from freeocc3d.pipeline import live_snapshots
from freeocc3d.pipeline.live_snapshots import color_voxels
from freeocc3d.storage import live_snapshot
from freeocc3d.storage.keyframes import Keyframes
from freeocc3d.storage.live_snapshot import SNAPSHOT, Snapshot, is_watched, read_snapshot, watch, write_snapshot
from freeocc3d.storage.run_lock import LOCK
from freeocc3d.viewer.browser.live_map import LiveMap
from freeocc3d.viewer.browser.server import make_app

SETTINGS = {"capture": {"stop": 40, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}},
            "fitting": {"passes": 0}}  # fmt: skip


def test_voxels_have_the_mean_color_of_their_points() -> None:
    points = np.array(((0.01, 0.01, 0.01), (0.09, 0.0, 0.05), (-0.01, 0.0, 0.0), (1e9, 0, 0)))
    colors = np.array(((10, 0, 0), (20, 4, 0), (99, 99, 99), (1, 1, 1)), np.uint8)
    voxels, mean = color_voxels(points, colors, 0.1, least=2)
    assert (voxels.tolist(), mean.tolist()) == ([[0, 0, 0]], [[15, 2, 0]])
    assert color_voxels(points, colors, 0.1, least=1)[0].tolist() == [[-1, 0, 0], [0, 0, 0]]


def test_only_a_fresh_mark_counts_as_watching(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not is_watched(tmp_path)
    watch(tmp_path)
    assert is_watched(tmp_path)
    monkeypatch.setattr(live_snapshot, "_FRESH_S", -1.0)
    assert not is_watched(tmp_path)
    watch(tmp_path / "gone")  # does nothing


def test_a_snapshot_is_read_as_written_and_damage_is_told(tmp_path: Path) -> None:
    assert read_snapshot(tmp_path) is None
    made = Snapshot("Being made", True, False, np.eye(4), 0.08, np.ones(3), np.ones((2, 3), np.int32),
                    np.ones((2, 3), np.uint8), np.zeros((5, 3), np.float32))  # fmt: skip
    write_snapshot(tmp_path, made)
    read = read_snapshot(tmp_path)
    assert read is not None
    assert {name: np.array(value).tolist() for name, value in vars(read).items()} == {
        name: np.array(value).tolist() for name, value in vars(made).items()
    }
    write_snapshot(tmp_path, replace(made, origin=np.full(3, np.nan)))
    with pytest.raises(MapError, match="is damaged"):
        read_snapshot(tmp_path)
    (tmp_path / SNAPSHOT).write_bytes((tmp_path / SNAPSHOT).read_bytes()[:99])
    with pytest.raises(MapError, match=SNAPSHOT):
        read_snapshot(tmp_path)


def test_a_run_that_nobody_watches_writes_no_snapshot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    monkeypatch.setattr(live_snapshots, "write_snapshot", lambda folder, snapshot: written.append(snapshot.stage))
    freeocc3d.reconstruct("builtin:room", tmp_path / "map", SETTINGS)
    assert not written


def test_a_map_is_followed_from_before_its_run_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_snapshots, "_PAUSE_S", 0.0)
    monkeypatch.setattr(live_snapshots, "_LOOK_S", 0.0)
    monkeypatch.setattr(live_snapshots, "_SHARE", 1.0)
    shown_one = threading.Semaphore(0)

    def write_and_wait(folder: Path, snapshot: Snapshot) -> None:
        write_snapshot(folder, snapshot)
        shown_one.acquire(timeout=20)  # so that each one is seen

    monkeypatch.setattr(live_snapshots, "write_snapshot", write_and_wait)
    path = tmp_path / "map"
    seen: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {}
    version = ""
    with TestClient(make_app([LiveMap(path)]), base_url="http://localhost") as client:
        assert client.get("/maps").json() == [{"name": "map", "capture": ""}]
        meta, _ = unpack(client.get("/maps/0/scene").content)
        assert (meta["version"], meta["live"].split(",")[0]) == ("waiting", "Waiting for a run to begin")
        refused = client.post("/maps/0/query", json={"words": ["red"]})
        assert (refused.status_code, "still being made" in refused.json()["error"]) == (422, True)
        run = threading.Thread(target=freeocc3d.reconstruct, args=("builtin:room", path, SETTINGS))
        run.start()
        deadline = time.monotonic() + 120
        while run.is_alive():
            assert time.monotonic() < deadline
            state = client.get("/maps/0/state")
            now = state.json()["version"] if state.status_code == 200 else version  # 422: the map takes its place
            if now.startswith("making") and now != version:
                version = now
                meta, arrays = unpack(client.get("/maps/0/scene").content)
                seen[meta["live"].rsplit(",", 1)[0]] = meta, arrays
                shown_one.release()
        run.join()
        meta, arrays = unpack(client.get("/maps/0/scene").content)
        assert "live" not in meta
        assert client.post("/maps/0/query", json={"words": ["red"]}).status_code == 200
    assert any("poses, frame" in stage for stage in seen)
    assert sorted(each.name for each in path.iterdir() if each.name in (SNAPSHOT, live_snapshot.WATCHED)) == []
    last, taken = seen["Being made: Gaussians are being fitted; words and voxels follow"]
    shown = np.array(last["voxels"]["origin"]) + 0.08 * (taken["voxels"][:, :3] + 0.5)
    final = np.array(meta["voxels"]["origin"]) + 0.08 * (arrays["voxels"][:, :3] + 0.5)
    near = [np.abs(final - point).max(axis=1).min() < 0.13 for point in shown[:: max(1, len(shown) // 300)]]
    assert np.mean(near) > 0.9


def test_who_watches_does_not_hide_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("_PAUSE_S", 0.0), ("_LOOK_S", 0.0), ("_SHARE", 1.0)):
        monkeypatch.setattr(live_snapshots, name, value)
    monkeypatch.setattr(live_snapshots, "is_watched", lambda folder: True)
    append, written = Keyframes.append, []

    def fail_third(self: Keyframes, frame: Frame) -> None:
        written.append(frame.index)
        if len(written) == 3:
            raise OSError(errno.ENOSPC, "No space left on device", "keyframe")
        append(self, frame)

    monkeypatch.setattr(Keyframes, "append", fail_third)
    with pytest.raises(MapError, match="the disk is full"):
        freeocc3d.reconstruct("builtin:room", tmp_path / "map", SETTINGS)


def test_a_folder_that_a_run_left_does_not_hide_the_map(tmp_path: Path) -> None:
    made = freeocc3d.reconstruct("builtin:room", tmp_path / "map", SETTINGS)
    left = tmp_path / "map.partial"
    left.mkdir()
    live = LiveMap(made.path)
    assert "live" not in unpack(gzip.decompress(live.scene()))[0]
    ended = subprocess.Popen(["true"])
    ended.wait()
    for said in (b"", b"{", json.dumps({"process": ended.pid, "host": socket.gethostname(), "since": ""}).encode()):
        (left / LOCK).write_bytes(said)
        assert not live.version.startswith(("making", "begun")), said
    assert not (left / live_snapshot.WATCHED).exists()
    (left / LOCK).write_text(json.dumps({"process": os.getpid(), "host": socket.gethostname(), "since": ""}))
    assert live.version == "begun"


def test_a_path_that_names_nothing_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MapError, match="cannot be the name of a map folder"):
        LiveMap(Path("/"))
    monkeypatch.chdir(tmp_path)
    assert LiveMap(Path(".")).path == tmp_path.resolve()


def test_packets_of_what_is_not_there_yet_hold_every_array(tmp_path: Path) -> None:
    meta, arrays = unpack(gzip.decompress(LiveMap(tmp_path / "none").scene()))
    assert meta["voxels"]["count"] == 0
    assert {"voxels", "colors", "path", "cameras", "means", "opacities"} <= set(arrays)
