"""From nothing to words: which model is used, fetching it by the commands, and giving a map its words later."""

from __future__ import annotations

import io
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import ready_made
from command_line import refused, run
from hubs import Hub, serve
from model_folders import dense_package, succeed

from freeocc3d import load_map
from freeocc3d.cli import words
from freeocc3d.core.errors import ModelError
from freeocc3d.core.progress import Progress
from freeocc3d.editing import relabeling
from freeocc3d.gaussians import anchors
from freeocc3d.language import encoding_speed, known_models, word_models
from freeocc3d.language.ready_made.export_packages import package_of_export
from freeocc3d.occupancy import build
from freeocc3d.query.scan_map import Map
from freeocc3d.settings import config

QUICK = ["capture.stride=12", "capture.color_focal=1", "capture.synthetic.width=160", "capture.synthetic.height=120",
         "tracking.backend=known", "fitting.passes=0", "language.keyframes=3"]  # fmt: skip
SET = [part for value in QUICK for part in ("--set", value)]


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FREEOCC3D_MODELS", str(tmp_path / "models"))
    return tmp_path / "models"


@pytest.fixture
def hub(tmp_path: Path, home: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch):
    folder = ready_made.copy_export(tmp_path_factory, tmp_path / "remote", "clip", "int8", "sdpa")
    with serve(folder, known_models.NAMES["clip-b16"]) as running:
        monkeypatch.setenv("HF_ENDPOINT", running.url)
        yield running


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Map:
    folder = tmp_path_factory.mktemp("words") / "room"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FREEOCC3D_MODELS", str(folder.parent / "none"))
        said = run("reconstruct", "builtin:room", "-o", folder, *SET)
    assert "'freeocc3d models pull words' gets one" in said.stderr
    return load_map(folder)


def test_the_best_installed_model_is_used(home: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    plain = config.resolve({})
    assert word_models.choose_encoder(plain)[0].language.encoder == "color"
    export = ready_made.copy_export(tmp_path_factory, tmp_path / "export", "clip", "int8", "sdpa")
    for name in ("another", "clip-b16"):
        package_of_export(export, home / name, "someone/tiny", "int8")
    dense_package(home / "dino")
    chosen, said = word_models.choose_encoder(plain)
    assert (chosen.language.encoder, chosen.given("language", "clip")["model"]) == ("clip", "clip-b16")
    assert said == "Words: the model clip-b16 (clip), the best that is installed."
    shutil.rmtree(home / "clip-b16")
    assert word_models.choose_encoder(plain)[0].given("language", "clip")["model"] == "another"
    named = config.resolve({"language": {"clip": {"model": "mine"}}})
    assert word_models.choose_encoder(named)[0].given("language", "clip")["model"] == "mine"
    color = config.resolve({"language": {"encoder": "color"}})
    assert word_models.choose_encoder(color) == (color, "")


def test_the_models_that_there_are_are_listed_with_their_speed(
    home: Path,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    export = ready_made.copy_export(tmp_path_factory, tmp_path / "export", "clip", "int8", "sdpa")
    package_of_export(export, home / "tiny", "someone/tiny", "int8")
    (home / "broken").mkdir()
    succeed(["models", "list", "--available", "--json"])
    rows = json.loads(capsys.readouterr().out)["models"]
    assert rows["tiny"]["installed"]
    assert not rows["tiny"]["estimated"]
    assert "is not a model package" in rows["broken"]["error"]
    for name, known in known_models.KNOWN.items():
        assert (rows[name]["source"], rows[name]["installed"]) == (known.repository, False)
        assert rows[name]["estimated"]
    assert (rows["mobileclip-s2"]["precision"], rows["sam-b"]["precision"]) == ("fp16", "fp32")
    assert rows["clip-b16"]["seconds"] == pytest.approx(211 / 52 * rows["clip-b32"]["seconds"])
    monkeypatch.setattr(encoding_speed, "FRAME", None)  # measured once: nothing is encoded again
    succeed(["models", "list", "--available"])
    lines = capsys.readouterr().out.splitlines()
    measured = next(line for line in lines if line.startswith("tiny "))
    assert f"{rows['tiny']['seconds']:.1f} s a keyframe (measured)" in measured
    assert "(estimated); needs 'freeocc3d models export', with torch" in next(x for x in lines if x.startswith("sam-b"))


def test_from_nothing_to_an_answer_in_two_commands(hub: Hub, home: Path, tmp_path: Path) -> None:
    run("reconstruct", "builtin:room", "-o", tmp_path / "map", "--words", "words", *SET)
    assert (home / "clip-b16").is_dir()
    answer = json.loads(run("query", tmp_path / "map", "chair", "--threshold", "-1", "--json").stdout)
    assert answer["results"][0]["word"] == "chair"
    assert load_map(tmp_path / "map").manifest.encoder.name == "clip"


def test_a_map_gets_words_later(room: Map, hub: Hub, tmp_path: Path) -> None:
    run("relabel", room.path, "-o", tmp_path / "map", "--words", "clip-b16")
    made = load_map(tmp_path / "map")
    assert (made.manifest.encoder.name, made.occupancy.features.shape[1]) == ("clip", 24)
    np.testing.assert_array_equal(made.occupancy.state, room.occupancy.state)
    np.testing.assert_array_equal(made.occupancy.colors, room.occupancy.colors)
    np.testing.assert_array_equal(made.trajectory.T_world_cam, room.trajectory.T_world_cam)
    assert made.query_words(["chair"], threshold=-1.0)[0].word == "chair"
    assert "exists: choose another folder" in refused("relabel", room.path, "-o", tmp_path / "map")


def test_a_relabeled_map_tells_its_own_times(room: Map, hub: Hub, tmp_path: Path) -> None:
    """And the stages of the run that its first map had, but for the features that it has no longer."""
    said = run("relabel", room.path, "-o", tmp_path / "map", "--words", "clip-b16").stdout
    assert f"relabeled  from {room.path} in " in said
    document = json.loads(run("info", tmp_path / "map", "--json").stdout)
    before = json.loads(run("info", room.path, "--json").stdout)
    assert before["relabeled"] is None
    assert document["seconds"] == {
        name: s for name, s in before["seconds"].items() if name not in ("language", "objects")
    }
    assert "language" in before["seconds"]
    assert document["relabeled"]["map"] == str(room.path)
    assert set(document["relabeled"]["seconds"]) == {"language", "occupancy", "words", "saving", "objects"}
    assert all(seconds >= 0 for seconds in document["relabeled"]["seconds"].values())


def test_voxels_get_the_features_that_a_run_gives_them(room: Map) -> None:
    settings, occupancy = relabeling.read_settings(room), room.occupancy
    edge = settings.occupancy.voxel_size
    scale = anchors.compute_least_scale(settings.gaussians, 0.5 * edge, edge)
    found = build.compute_features(occupancy, room.gaussians, room.gaussian_features, settings.occupancy, scale)
    expected = np.asarray(occupancy.features, np.float32)
    cosine = np.einsum("vd,vd->v", found.astype(np.float32), expected)
    known = expected.any(axis=1)
    assert known.mean() > 0.5
    assert (found.any(axis=1) == known).mean() > 0.999
    assert np.quantile(cosine[known], 0.001) > 0.99


def test_on_a_terminal_it_asks_before_it_fetches(
    hub: Hub, home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    asked = Terminal()
    monkeypatch.setattr(sys, "stdin", Terminal("n\n"))
    monkeypatch.setattr(sys, "stderr", asked)
    with pytest.raises(ModelError, match="is not installed: fetch it with 'freeocc3d models pull words'"):
        words.obtain_words("words", Progress())
    assert f"Fetch {known_models.NAMES['clip-b16']}? [Y/n]" in asked.getvalue()
    assert not hub.requested
    monkeypatch.setattr(sys, "stdin", Terminal("\n"))
    assert words.obtain_words("words", Progress()).folder == home / "clip-b16"


def test_without_a_network_and_a_model_it_is_one_sentence(
    room: Map, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FREEOCC3D_OFFLINE", "1")
    out = ["-o", tmp_path / "map"]
    assert "is not fetched, because FREEOCC3D_OFFLINE is set" in refused("relabel", room.path, *out)
    unknown = refused("reconstruct", "builtin:room", *out, "--words", "clip-b17")
    assert "'clip-b17' is neither an installed model nor a repository OWNER/NAME of the hub (did you mean" in unknown
    (home / "clip-b16").mkdir(parents=True)
    assert "is not a model package" in refused("relabel", room.path, *out)
