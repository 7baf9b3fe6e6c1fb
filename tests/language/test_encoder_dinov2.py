"""The dinov2 encoder: patches against transformers' own, words against CLIP's text through the head."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
import tiny_models
import torch
from tiny_models import frame
from torch.nn import functional as F

from freeocc3d.core.errors import ConfigError
from freeocc3d.language.encoders import dinov2
from freeocc3d.language.model_export.checkpoint_networks import build_text_aligned
from freeocc3d.language.model_export.package_writer import write_package
from freeocc3d.language.patch_features import resample_patches


def head() -> dict[str, torch.Tensor]:
    """Talk2DINO's projection from CLIP's 24 to DINOv2's 32 dimensions."""
    with tiny_models.seeded(7):
        return {
            "linear_layer.weight": torch.randn(32, 24), "linear_layer.bias": torch.randn(32),
            "linear_layer2.weight": torch.randn(32, 32), "linear_layer2.bias": torch.randn(32),
        }  # fmt: skip


@pytest.fixture(scope="module", params=[0, 2], ids=["", "registers"])
def registers(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, registers: int) -> Path:
    made = tmp_path_factory.mktemp("models") / "talk2dino"
    model = tiny_models.dinov2(registers=registers)
    checkpoint = build_text_aligned(model, tiny_models.clip(), tiny_models.tokenizer(), head())
    write_package(checkpoint, made, made.name, "random weights", "none")
    return made


@pytest.mark.parametrize("size", [(28, 28), (35, 56), (14, 21)])
def test_patches_equal_transformers_forward_pass(folder: Path, registers: int, size: tuple[int, int]) -> None:
    shown = frame(*size)
    made = dinov2.load(dinov2.Options(model=str(folder), short_side=max(16, min(size)), stride=0))
    if min(size) < 16:  # below what the option allows
        made = dinov2.Dinov2Encoder(made.package, made.options)
        msgspec.structs.force_setattr(made.options, "short_side", min(size))
    rgb = torch.from_numpy(shown.color).float() / 255
    given = ((rgb - torch.tensor(made.package.mean)) / torch.tensor(made.package.std)).permute(2, 0, 1)[None]
    with torch.no_grad():
        tokens = tiny_models.dinov2(registers=registers)(given).last_hidden_state[0, 1 + registers :]
    expected = F.normalize(tokens, dim=-1).reshape(size[0] // 7, size[1] // 7, -1).numpy()
    assert np.abs(made.encode(shown) - expected).max() < 1e-3


def test_words_are_clips_through_the_head(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FREEOCC3D_MODELS", str(tmp_path))
    made = dinov2.load(dinov2.Options(model=str(folder), templates=("a {}.",)))
    found = dinov2.load_text(made.text_state()).encode_words(["chair"]).features
    from tokenizers import Tokenizer

    tokens = Tokenizer.from_file(str(folder / "tokenizer.json")).encode("a chair.").ids
    weights = head()
    with torch.no_grad():
        text = tiny_models.clip().get_text_features(torch.tensor([tokens]))
        text = getattr(text, "pooler_output", text)
        hidden = torch.tanh(F.linear(text, weights["linear_layer.weight"], weights["linear_layer.bias"]))
        out = F.linear(hidden, weights["linear_layer2.weight"], weights["linear_layer2.bias"])
    assert np.abs(found - F.normalize(out, dim=-1).numpy()).max() < 1e-4


def test_windows_and_upsampling(folder: Path) -> None:
    made = dinov2.load(dinov2.Options(model=str(folder), short_side=42, window=28, stride=5))
    features = made.encode(frame(61, 93))
    assert features.shape == (13, 19, 32)
    assert np.linalg.norm(features.astype(np.float32), axis=-1) == pytest.approx(1, abs=2e-3)


def test_resampling_equals_pytorchs() -> None:
    values = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    for grid in ((11, 9), (5, 7), (20, 28)):
        given = torch.from_numpy(values).permute(2, 0, 1)[None]
        expected = F.interpolate(given, size=grid, mode="bilinear", align_corners=False)[0].permute(1, 2, 0).numpy()
        assert np.abs(resample_patches(values, grid) - expected).max() < 1e-5


def test_options_out_of_range_are_reported() -> None:
    with pytest.raises(ConfigError, match="'short_side' must be from 16 to 4096"):
        dinov2.Options(short_side=0)
