"""Stages of a run: interruption, resuming, a full disk, and names by a vision-language model."""

from __future__ import annotations

import errno
import json

import numpy as np
import pytest
from pipeline_runs import ONE_PASS, ROOM, content, listing, notices
from vision_servers import saying, serving

import freeocc3d
from freeocc3d.core.errors import CaptureError, ConfigError, FreeOccError, Interrupted, MapError
from freeocc3d.core.progress import Progress
from freeocc3d.pipeline import run_stages
from freeocc3d.pipeline.mapper import Mapper
from freeocc3d.storage import writer
from freeocc3d.storage.manifest import NameCount


class Stopper(Progress):
    """Ctrl-C after some frames of a stage."""

    def __init__(self, stage: str, after: int):
        self.target, self.after, self.now = stage, after, ""

    def stage(self, name, total=None) -> None:
        self.now = name

    def advance(self, done) -> None:
        if self.now == self.target and done == self.after:
            raise KeyboardInterrupt


def test_a_run_that_is_interrupted_while_tracking_resumes_to_the_same(tmp_path, room, monkeypatch) -> None:
    monkeypatch.setattr(run_stages, "_CHECKPOINT_FRAMES", 5)
    output = tmp_path / "map"
    with pytest.raises(Interrupted, match="nothing is kept"):
        freeocc3d.reconstruct("builtin:room", output, ROOM, progress=Stopper("tracking", 3))
    with pytest.raises(Interrupted, match="--resume"):
        freeocc3d.reconstruct("builtin:room", output, ROOM, progress=Stopper("tracking", 12))
    assert not output.exists()
    spent = json.loads(str(np.load(tmp_path / "map.partial" / "tracking.a.npz")["log"]))["seconds"]["tracking"]
    assert spent > 0
    with pytest.raises(MapError, match="--resume"):
        freeocc3d.reconstruct("builtin:room", output, ROOM)
    resumed = freeocc3d.reconstruct("builtin:room", output, ROOM, resume=True)
    assert not (tmp_path / "map.partial").exists()
    assert content(resumed.path) == content(room.path)
    assert resumed.report["seconds"]["tracking"] > spent


def test_a_run_that_is_interrupted_later_takes_up_refined_poses(tmp_path, room, monkeypatch) -> None:
    with pytest.raises(Interrupted):
        freeocc3d.reconstruct("builtin:room", tmp_path / "map", ROOM, progress=Stopper("language", 1))
    assert not (tmp_path / "map").exists()

    def refuse(self) -> None:
        raise AssertionError("the poses are refined already")

    monkeypatch.setattr(Mapper, "refine", refuse)
    resumed = freeocc3d.reconstruct("builtin:room", tmp_path / "map", ROOM, resume=True)
    assert content(resumed.path) == content(room.path)


def test_a_run_is_not_resumed_with_other_options_and_loses_nothing_by_the_attempt(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(run_stages, "_CHECKPOINT_FRAMES", 5)
    output, work = tmp_path / "map", tmp_path / "map.partial"
    with pytest.raises(Interrupted):
        freeocc3d.reconstruct("builtin:room", output, ROOM, progress=Stopper("tracking", 12))
    before = listing(work)
    for other in ({"tracking": {"backend": "known"}}, {"tracking": {"rgbd": {"neighbours": -1}}}):
        with pytest.raises(FreeOccError):
            freeocc3d.reconstruct("builtin:room", output, {**ROOM, **other}, resume=True)
    with pytest.raises(CaptureError):
        freeocc3d.reconstruct(tmp_path / "typo", output, overwrite=True)
    assert listing(work) == before
    more_broken = {**ROOM, "capture": {**ROOM["capture"], "max_broken": 0.5}}
    assert freeocc3d.reconstruct("builtin:room", output, more_broken, resume=True).trajectory.has_pose[:24].all()


def test_a_disk_that_fills_up_at_the_very_end_costs_nothing(tmp_path, room, monkeypatch) -> None:
    def full(*arguments) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(writer, "write_manifest", full)
        with pytest.raises(MapError, match="disk is full"):
            freeocc3d.reconstruct("builtin:room", tmp_path / "map", ROOM)
    kept = np.load(tmp_path / "map.partial" / "tracking.b.npz")
    assert int(kept["done"]) == 24
    assert content(freeocc3d.reconstruct("builtin:room", tmp_path / "map", ROOM, resume=True).path) == content(
        room.path
    )


def test_a_full_disk_is_reported_and_what_was_done_is_kept(tmp_path, monkeypatch) -> None:
    from freeocc3d.storage.keyframes import Keyframes

    written = []

    def append(self, frame) -> None:
        if len(written) == 1:
            raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "x"))
        written.append(frame.index)
        original(self, frame)

    original = Keyframes.append
    monkeypatch.setattr(Keyframes, "append", append)
    with pytest.raises(MapError, match=r"disk is full.*--resume"):
        freeocc3d.reconstruct("builtin:room", tmp_path / "map", ROOM)
    assert not (tmp_path / "map").exists()


def test_a_run_with_two_submaps_resumes_to_the_same(tmp_path, glued, two_places, monkeypatch) -> None:
    def full(*arguments) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(writer, "write_manifest", full)
        with pytest.raises(MapError, match="disk is full"):
            freeocc3d.reconstruct(glued, tmp_path / "map", ONE_PASS)
    resumed = freeocc3d.reconstruct(glued, tmp_path / "map", ONE_PASS, resume=True)
    assert content(resumed.path) == content(two_places.path)


def _with_vocabulary(url: str, **more) -> dict:
    return {
        **ROOM,
        "fitting": {"passes": 0},
        "vocabulary": {"endpoint": url, "model": "a-model", "keyframes": 3, "retries": 0, **more},
    }


def test_names_by_a_model_are_kept_in_the_map_and_its_key_is_not(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("ROOM_KEY", "sk-never-written")
    with serving(saying('["table", "red cup"]', '["table"]')) as server:
        settings = _with_vocabulary(server.url, api_key_env="ROOM_KEY")
        made = freeocc3d.reconstruct("builtin:room", tmp_path / "map", settings)
    named = made.manifest.vocabulary
    assert len(server.asked) == len(named.keyframes) == 3
    assert set(named.keyframes) <= set(made.manifest.keyframes)
    assert named.names["table"] == NameCount(count=3, keyframes=named.keyframes)
    assert named.names["red cup"].count == 1
    assert made.report["seconds"]["vocabulary"] > 0
    assert server.headers[0]["Authorization"] == "Bearer sk-never-written"
    assert not any(b"never-written" in content for content in listing(made.path).values())
    assert "vocabulary.stage.json" not in listing(made.path)


def test_a_model_that_cannot_be_asked_costs_names_and_a_warning(tmp_path) -> None:
    made = freeocc3d.reconstruct("builtin:room", tmp_path / "map", _with_vocabulary("http://127.0.0.1:9/v1"))
    assert made.manifest.vocabulary.names == {}
    (warning,) = (notice.text for notice in notices(made) if notice.code == "vocabulary-incomplete")
    assert "lacks 3 of 3 keyframes" in warning
    assert made.query("red").matched


def test_a_resumed_run_asks_for_no_keyframe_twice(tmp_path) -> None:
    with serving(saying('["table"]')) as server:
        settings = _with_vocabulary(server.url)
        for stage, after in (("vocabulary", 2), ("language", 1)):
            with pytest.raises(Interrupted):
                freeocc3d.reconstruct(
                    "builtin:room",
                    tmp_path / "map",
                    settings,
                    progress=Stopper(stage, after),
                    resume=stage != "vocabulary",
                )
        made = freeocc3d.reconstruct("builtin:room", tmp_path / "map", settings, resume=True)
    assert len(server.asked) == 3
    assert made.manifest.vocabulary.names["table"].count == 3


def test_a_key_that_is_not_set_is_reported_before_any_work(tmp_path, monkeypatch) -> None:
    monkeypatch.delenv("ROOM_KEY", raising=False)
    with pytest.raises(ConfigError, match="ROOM_KEY"):
        freeocc3d.reconstruct(
            "builtin:room", tmp_path / "map", _with_vocabulary("http://127.0.0.1:9/v1", api_key_env="ROOM_KEY")
        )
    assert not (tmp_path / "map.partial").exists()
