"""A map whose features are a model package's: from the built-in room to words, and what happens without the model."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import tiny_models

import freeocc3d
from freeocc3d.cli.main import main
from freeocc3d.core.errors import FreeOccError, ModelError
from freeocc3d.query.scan_map import load_map

QUICK = {
    "capture": {"synthetic": {"frames": 240, "width": 160, "height": 120}, "stop": 16, "color_focal": 1.0},
    "tracking": {"backend": "known"},
    "fitting": {"passes": 0},
}


@pytest.fixture
def model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FREEOCC3D_MODELS", str(tmp_path / "models"))
    return tiny_models.clip_package(tmp_path / "models" / "tiny")


def test_a_map_is_made_asked_and_outlives_its_model(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    language = {"encoder": "clip", "clip": {"model": "tiny", "short_side": 64, "threshold": 0.0, "stride": 8}}
    made = freeocc3d.reconstruct("builtin:room", tmp_path / "map", {**QUICK, "language": language})
    assert made.manifest.encoder.dimension == 24
    assert made.gaussian_features.any(axis=1).mean() > 0.9
    state = made.manifest.encoder.state
    assert (state["model"], state["folder"]) == ("tiny", str(model))

    loaded = load_map(tmp_path / "map")
    result = loaded.query("椅子", threshold=-1.0)
    assert result.understood == "椅子"
    text = loaded.text_encoder.encode_words(["椅子"]).features[0]
    features = np.asarray(loaded.occupancy.features).astype(np.float32)
    assert result.scores == pytest.approx(features @ text, abs=0.01)
    with pytest.raises(FreeOccError, match="10000 characters"):
        loaded.query("x" * 10_000)
    with pytest.raises(FreeOccError, match="A word is empty"):
        loaded.query(" ")

    thing = loaded.objects(views=1)[0]
    x0, y0, x1, y1 = thing.keyframes[0].box
    rgb = loaded.keyframes[loaded.keyframes.frames.index(thing.keyframes[0].frame)].color
    across, down = round(0.1 * (x1 - x0 + 1)), round(0.1 * (y1 - y0 + 1))
    part = rgb[max(y0 - down, 0) : y1 + down + 1, max(x0 - across, 0) : x1 + across + 1]
    assert thing.feature == pytest.approx(loaded.encoder.embed(part), abs=1e-6)

    shutil.rmtree(model)
    again = load_map(tmp_path / "map")
    without = again.objects(views=1)[0]
    assert np.array_equal(without.rows, thing.rows)
    mean = features[thing.rows].sum(axis=0)
    assert without.feature == pytest.approx(mean / np.linalg.norm(mean), abs=1e-4)
    assert again.query("椅子", threshold=-1.0).scores == pytest.approx(result.scores, abs=1e-5)
    with pytest.raises(ModelError, match="need the text part of the model 'tiny'"):
        again.query("a word of another day")
    with pytest.raises(SystemExit, match="1"):
        main(["query", str(tmp_path / "map"), "another word"])
    assert "Copy its folder there" in capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        main(["info", str(tmp_path / "map"), "--json"])
    assert end.value.code == 0
    assert json.loads(capsys.readouterr().out)["encoder"] == "clip"


def test_a_model_that_is_not_there_is_reported_before_any_work(model: Path, tmp_path: Path) -> None:
    language = {"encoder": "clip", "clip": {"model": "tinny"}}
    with pytest.raises(ModelError, match=r"There is no model 'tinny' \(did you mean 'tiny'\?\)"):
        freeocc3d.reconstruct("builtin:room", tmp_path / "map", {**QUICK, "language": language})
    assert not list(tmp_path.glob("map*"))
