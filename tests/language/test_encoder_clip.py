"""The clip encoder: exported networks against transformers' own, replaced attention against plain PyTorch."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import tiny_models
import torch
from numpy.typing import NDArray
from tiny_models import frame
from torch.nn import functional as F

from freeocc3d.core.errors import ConfigError, ModelError
from freeocc3d.language import model_packages
from freeocc3d.language.encoders import clip
from freeocc3d.language.model_export.checkpoint_networks import build_siglip
from freeocc3d.language.model_export.package_writer import write_package

SIZES = ((32, 32), (48, 80), (24, 16), (64, 104))
"""Heights and widths in pixels; the first is that of training."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_models.clip_package(tmp_path_factory.mktemp("models") / "tiny-clip")


@pytest.fixture(scope="module")
def siglip_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("models") / "tiny-siglip"
    checkpoint = build_siglip(tiny_models.siglip(), tiny_models.tokenizer(), [0.5] * 3, [0.5] * 3)
    write_package(checkpoint, made, made.name, "random weights", "none")
    return made


def encoder(folder: Path, **options: Any) -> clip.ClipEncoder:
    return clip.load(clip.Options(model=str(folder), **options))


def images(height: int, width: int, batch: int = 2) -> NDArray[np.float32]:
    return np.random.default_rng(height * width).normal(size=(batch, 3, height, width)).astype(np.float32)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_the_image_pair_equals_transformers_forward_pass(folder: Path, height: int, width: int) -> None:
    given = images(height, width)
    with torch.no_grad():
        expected = tiny_models.clip().get_image_features(torch.from_numpy(given), interpolate_pos_encoding=True)
    expected = getattr(expected, "pooler_output", expected).numpy()
    assert np.abs(encoder(folder).pooled(given) - expected).max() < 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_siglip_equals_transformers_forward_pass(siglip_folder: Path, height: int, width: int) -> None:
    given = images(height, width)
    with torch.no_grad():
        expected = tiny_models.siglip().get_image_features(torch.from_numpy(given), interpolate_pos_encoding=True)
    expected = getattr(expected, "pooler_output", expected).numpy()
    assert np.abs(encoder(siglip_folder).pooled(given) - expected).max() < 1e-4 * np.abs(expected).max()


def test_naflex_equals_transformers_forward_pass(tmp_path: Path) -> None:
    model = tiny_models.naflex()
    checkpoint = build_siglip(model, tiny_models.tokenizer(), [0.5] * 3, [0.5] * 3)
    write_package(checkpoint, tmp_path / "naflex", "naflex", "random weights", "none")
    for height, width in ((32, 32), (24, 80)):
        given = torch.from_numpy(images(height, width))
        patches = given.reshape(2, 3, height // 8, 8, width // 8, 8).permute(0, 2, 4, 3, 5, 1).flatten(3).flatten(1, 2)
        shapes = torch.tensor([[height // 8, width // 8]] * 2)
        with torch.no_grad():
            mask = torch.ones(patches.shape[:2], dtype=torch.int64)
            expected = model.get_image_features(patches, pixel_attention_mask=mask, spatial_shapes=shapes)
        expected = getattr(expected, "pooler_output", expected).numpy()
        found = encoder(tmp_path / "naflex").pooled(given.numpy())
        assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()
    assert encoder(tmp_path / "naflex").package.input_size == 32


def plain_dense(model: Any, pixels: torch.Tensor, attention: str, grid: tuple[int, int]) -> torch.Tensor:
    """(B, h w, D) dense features of transformers' CLIP, the last block written as each paper has it."""
    vision = model.vision_model
    x = vision.pre_layrnorm(vision.embeddings(pixels, interpolate_pos_encoding=True))
    for layer in vision.encoder.layers[:-1]:
        x = layer(x, None)
        x = x[0] if isinstance(x, tuple) else x
    last = vision.encoder.layers[-1]
    own, y = last.self_attn, last.layer_norm1(x)
    width = x.shape[-1] // own.num_heads
    out = torch.empty_like(x)
    for b in range(len(x)):
        for head in range(own.num_heads):
            part = slice(head * width, (head + 1) * width)
            q, k, v = (project(y[b])[:, part] for project in (own.q_proj, own.k_proj, own.v_proj))
            s = width**-0.5
            qq, kk, qk = s * q @ q.T, s * k @ k.T, s * q @ k.T
            weights = {
                "plain": F.softmax(qk, -1),
                "maskclip": torch.eye(len(q)),
                "sclip": F.softmax(qq, -1) + F.softmax(kk, -1),
                "clearclip": F.softmax(qq, -1),
                "naclip": F.softmax(kk + window(grid), -1),
            }[attention]
            out[b, :, part] = weights @ v
    out = own.out_proj(out)
    if attention in ("plain", "sclip"):
        out = x + out
        out = out + last.mlp(last.layer_norm2(out))
    return model.visual_projection(vision.post_layernorm(out))[:, 1:]


def window(grid: tuple[int, int]) -> torch.Tensor:
    """NACLIP's addition, a pair of patches at a time; nothing for the class token."""
    places = [(i, j) for i in range(grid[0]) for j in range(grid[1])]
    added = torch.zeros(len(places) + 1, len(places) + 1)
    for a, (i, j) in enumerate(places):
        for b, (k, m) in enumerate(places):
            added[a + 1, b + 1] = np.exp(-((i - k) ** 2 + (j - m) ** 2) / (2 * 5.0**2))
    return added


@pytest.mark.parametrize("attention", get_args(clip.Attention))
@pytest.mark.parametrize("size", [(32, 32), (40, 56)])
def test_dense_features_equal_plain_pytorch(folder: Path, attention: str, size: tuple[int, int]) -> None:
    made = encoder(folder, attention=attention, short_side=min(size), window=0, stride=0)
    shown = frame(*size)
    got = made.encode(shown)
    package = made.package
    pixels = (torch.from_numpy(shown.color).float() / 255 - torch.tensor(package.mean)) / torch.tensor(package.std)
    grid = size[0] // 8, size[1] // 8
    with torch.no_grad():
        expected = plain_dense(tiny_models.clip(), pixels.permute(2, 0, 1)[None], attention, grid)
    expected = F.normalize(expected, dim=-1).reshape(*grid, -1).numpy()
    assert got.shape == expected.shape
    assert np.abs(got - expected).max() < 1e-3


def test_siglips_patches_are_its_pooling_attending_to_one_patch(siglip_folder: Path) -> None:
    made = encoder(siglip_folder, attention="plain", short_side=32, window=0, stride=0)
    shown = frame(32, 48)
    vision = tiny_models.siglip().vision_model
    pixels = (torch.from_numpy(shown.color).float() / 255 - 0.5) / 0.5
    with torch.no_grad():
        tokens = vision(pixels.permute(2, 0, 1)[None], interpolate_pos_encoding=True).last_hidden_state[0]
        expected = torch.cat([vision.head(token[None, None]) for token in tokens])
    expected = F.normalize(expected, dim=-1).reshape(4, 6, -1).numpy()
    assert np.abs(made.encode(shown) - expected).max() < 1e-3


def test_one_window_as_large_as_the_frame_is_the_frame(folder: Path) -> None:
    shown = frame(32, 32)
    windowed = encoder(folder, short_side=32, stride=0)  # 32 is the size of training
    assert np.array_equal(windowed.encode(shown), encoder(folder, short_side=32, window=0, stride=0).encode(shown))


def test_windows_are_spliced_where_they_belong(folder: Path) -> None:
    """A patch's feature is the normalized mean of what the windows over it say, each encoded as a frame of its own."""
    shown = frame(48, 72)
    got = encoder(folder, short_side=48, stride=0).encode(shown).astype(np.float32)
    alone = encoder(folder, short_side=32, window=0, stride=0)
    total, counts = np.zeros((6, 9, 24), np.float32), np.zeros((6, 9, 1))
    for top in (0, 2):
        for left in (0, 2, 5):
            crop = np.ascontiguousarray(shown.color[top * 8 : top * 8 + 32, left * 8 : left * 8 + 32])
            total[top : top + 4, left : left + 4] += alone.patches(crop)
            counts[top : top + 4, left : left + 4] += 1
    mean = total / counts
    assert np.abs(got - mean / np.linalg.norm(mean, axis=-1, keepdims=True)).max() < 1e-3
    assert not np.allclose(alone.patches(crop), got[2:6, 5:9], atol=0.01)


def test_features_are_unit_and_as_dense_as_asked(folder: Path) -> None:
    made = encoder(folder, short_side=48, stride=4)
    features = made.encode(frame(61, 93))
    assert features.shape == (16, 24, 24) == (-(-61 // 4), -(-93 // 4), made.dimension)
    assert features.dtype == np.float16
    assert np.linalg.norm(features.astype(np.float32), axis=-1) == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize(("precision", "least"), [("fp16", 0.999), ("int8", 0.95)])
def test_other_precisions_stay_near(folder: Path, tmp_path: Path, precision: str, least: float) -> None:
    other = tiny_models.clip_package(tmp_path / precision, precision)
    assert model_packages.read_package(other).precision == precision
    shown = frame()
    exact, near = (encoder(path, short_side=48, stride=0).encode(shown).astype(np.float32) for path in (folder, other))
    assert (exact * near).sum(axis=-1).min() > least
    assert sum(f.stat().st_size for f in other.glob("*.onnx")) < sum(f.stat().st_size for f in folder.glob("*.onnx"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"attention": "nackclip"}, "'attention' must be plain, maskclip"),
        ({"short_side": 3}, "'short_side' must be from 16 to 4096"),
        ({"window": -1}, "'window' must be from 0 to 4096"),
        ({"stride": -1}, "'stride' must be from 0 to 4096"),
        ({"templates": ("a photo",)}, "Each of 'templates' must contain {}"),
        ({"contrast": ("wall", " ")}, "'contrast' must not contain empty words"),
    ],
)
def test_options_out_of_range_are_reported(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        clip.Options(model="x", **options)


def test_a_device_that_is_not_there_is_reported(folder: Path) -> None:
    with pytest.raises(ConfigError, match="does not run on cuda:0"):
        encoder(folder, device="cuda:0")
    with pytest.raises(ConfigError, match="must be cpu or cuda:0"):
        encoder(folder, device="tpu")


def test_no_model_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FREEOCC3D_MODELS", str(tmp_path))
    with pytest.raises(ModelError, match=r"language\.clip\.model is empty"):
        clip.load(clip.Options())
