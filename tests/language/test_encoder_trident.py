"""The trident encoder against its steps in plain PyTorch, on transformers' own models."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import tiny_models
import torch
from numpy.typing import NDArray
from tiny_models import frame
from torch.nn import functional as F

from freeocc3d.core.errors import ConfigError, ModelError
from freeocc3d.language.encoders import trident
from freeocc3d.language.encoders.trident import correlate_patches, gate_attention, pool_masks
from freeocc3d.language.model_export.checkpoint_networks import build_backbone, build_sam
from freeocc3d.language.model_export.package_writer import write_package

DINO_MEAN, DINO_STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
GRID = 6, 8
"""Patches of a frame of 48 x 64 pixels, CLIP's as well as SAM's."""
CORNERS = [(top, left) for top in (0, 2) for left in (0, 2, 4)]
"""Windows of 4 x 4 patches."""


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    root = tmp_path_factory.mktemp("models")
    tiny_models.clip_package(root / "clip")
    for name, checkpoint in (
        ("dino", build_backbone(tiny_models.dinov2(), DINO_MEAN, DINO_STD)),
        ("sam", build_sam(tiny_models.sam(), DINO_MEAN, DINO_STD)),
    ):
        write_package(checkpoint, root / name, name, "random weights", "none")
    return {"model": str(root / "clip"), "dino": str(root / "dino"), "sam": str(root / "sam")}


def encoder(folders: dict[str, str], **options: Any) -> trident.TridentEncoder:
    return trident.load(trident.Options(**folders, short_side=48, window=32, stride=0, **options))


def pixels(rgb: NDArray[np.uint8], mean: list[float], std: list[float], patch: int) -> torch.Tensor:
    """(1, 3, H, W) normalized, GRID patches."""
    size = GRID[1] * patch, GRID[0] * patch
    resized = torch.from_numpy(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)).float() / 255
    return ((resized - torch.tensor(mean)) / torch.tensor(std)).permute(2, 0, 1)[None]


def window(image: torch.Tensor, corner: tuple[int, int], patch: int) -> torch.Tensor:
    top, left = (patch * n for n in corner)
    return image[:, :, top : top + 4 * patch, left : left + 4 * patch]


def spliced(rgb: NDArray[np.uint8], beta: float, gamma: float) -> torch.Tensor:
    """(6, 8, width): CLIP's values in each window, mixed by DINO's correlation; the windows' mean."""
    vision, dino = tiny_models.clip().vision_model, tiny_models.dinov2()
    clip_image = pixels(rgb, tiny_models.CLIP_MEAN, tiny_models.CLIP_STD, 8)
    dino_image = pixels(rgb, DINO_MEAN, DINO_STD, 7)
    total, count = torch.zeros(*GRID, 48), torch.zeros(*GRID, 1)
    last = vision.encoder.layers[-1]
    for top, left in CORNERS:
        out = vision(window(clip_image, (top, left), 8), interpolate_pos_encoding=True, output_hidden_states=True)
        values = last.self_attn.v_proj(last.layer_norm1(out.hidden_states[-2]))[0, 1:]
        seen = F.normalize(dino(window(dino_image, (top, left), 7)).last_hidden_state[0, 1:], dim=-1)
        S = seen @ seen.T
        A = gamma * (S - beta * S.mean())
        A[A < 0] = float("-inf")
        total[top : top + 4, left : left + 4] += (F.softmax(A, dim=-1) @ values).reshape(4, 4, -1)
        count[top : top + 4, left : left + 4] += 1
    return total / count


def square(rgb: NDArray[np.uint8]) -> torch.Tensor:
    return F.pad(pixels(rgb, DINO_MEAN, DINO_STD, 8), (0, 0, 0, 16))


def gathered(rgb: NDArray[np.uint8], cosine: float) -> torch.Tensor:
    """(6, 8, D) unit features before SAM's masks."""
    clip, sam = tiny_models.clip(), tiny_models.sam()
    seen = sam.vision_encoder(square(rgb), output_attentions=True)
    inside = torch.arange(64).reshape(8, 8)[:6].flatten()
    attention = seen.attentions[-1].reshape(3, 64, 64).mean(dim=0)[inside][:, inside]
    f = F.normalize(seen.last_hidden_state[0].flatten(1).T[inside], dim=-1)
    S = f @ f.T
    A = torch.where(cosine * S.mean() <= S, attention, 0)
    mixed = A / A.sum(dim=1, keepdim=True) @ spliced(rgb, 1.2, 3.0).flatten(0, 1)
    out = clip.vision_model.post_layernorm(clip.vision_model.encoder.layers[-1].self_attn.out_proj(mixed))
    return F.normalize(clip.visual_projection(out), dim=-1).reshape(*GRID, -1)


def test_splicing_equals_plain_pytorch(folders: dict[str, str]) -> None:
    rgb = frame(48, 64).color
    with torch.no_grad():
        expected = spliced(rgb, 1.2, 3.0).numpy()
    assert np.abs(encoder(folders).spliced(rgb) - expected).max() < 1e-4


def test_gathering_equals_plain_pytorch(folders: dict[str, str]) -> None:
    shown = frame(48, 64)
    with torch.no_grad():
        expected = gathered(shown.color, 1.2).numpy()
    got = encoder(folders, points=0).encode(shown)
    assert got.shape == expected.shape
    assert np.abs(got - expected).max() < 2e-3


def test_refinement_equals_plain_pytorch(folders: dict[str, str]) -> None:
    """Points 16 pixels apart; the best of three masks each; means of the features within, at half a patch."""
    shown = frame(48, 64)
    sam = tiny_models.sam()
    xs, ys = torch.arange(8.0, 64, 16), torch.arange(8.0, 48, 16)
    points = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), dim=-1).reshape(1, -1, 1, 2)
    with torch.no_grad():
        coarse = gathered(shown.color, 1.2)
        found = sam(pixel_values=square(shown.color), input_points=points, multimask_output=True)
        finer = F.interpolate(coarse.permute(2, 0, 1)[None], scale_factor=2, mode="bilinear", align_corners=False)
        finer = F.normalize(finer[0].permute(1, 2, 0), dim=-1)
        total, weights = torch.zeros_like(finer), torch.zeros(12, 16, 1)
        for masks, scores in zip(found.pred_masks[0], found.iou_scores[0], strict=True):
            covers = (masks[scores.argmax()] > 0).float()[:24, :32]
            share = F.avg_pool2d(covers[None], 2)[0][..., None]
            if share.any():
                mean = (share * finer).sum(dim=(0, 1)) / share.sum()
                total += scores.max() * share * mean
                weights += scores.max() * share
        expected = F.normalize(torch.where(weights != 0, total / weights, finer), dim=-1).numpy()
    got = encoder(folders, points=4, mask_score=-100.0).encode(shown)
    assert got.shape == (12, 16, 24)
    assert np.abs(got - expected).max() < 5e-3


def test_without_sure_masks_features_stay_as_gathered(folders: dict[str, str]) -> None:
    shown = frame(48, 64)
    with torch.no_grad():
        coarse = gathered(shown.color, 1.2).permute(2, 0, 1)[None]
        finer = F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
    got = encoder(folders, points=4, mask_score=100.0).encode(shown)
    assert np.abs(got - F.normalize(finer, dim=-1).numpy()).max() < 2e-3


@pytest.mark.parametrize("size", [(48, 64), (61, 93), (64, 48), (40, 40)])
def test_features_are_unit_and_cover_any_frame(folders: dict[str, str], size: tuple[int, int]) -> None:
    made = trident.load(trident.Options(**folders, short_side=48, window=32, stride=4))
    features = made.encode(frame(*size))
    assert features.shape == (-(-size[0] // 4), -(-size[1] // 4), 24)
    assert np.linalg.norm(features.astype(np.float32), axis=-1) == pytest.approx(1, abs=2e-3)


def test_patches_that_are_all_alike_attend_to_themselves() -> None:
    alike = np.ones((5, 3), np.float32)
    assert correlate_patches(alike, 1.2, 3.0) == pytest.approx(np.eye(5))
    assert gate_attention(np.full((5, 5), 0.2, np.float32), alike, 1.2) == pytest.approx(np.eye(5))


def test_attention_rows_sum_to_one() -> None:
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(30, 8)).astype(np.float32)
    attention = rng.random((30, 30)).astype(np.float32)
    for weights in (correlate_patches(seen, 1.2, 3.0), gate_attention(attention, seen, 1.2)):
        assert weights.sum(axis=1) == pytest.approx(1, abs=1e-5)
        assert (weights == 0).any()


def test_pooling_is_the_weighted_mean_of_masks_means() -> None:
    rng = np.random.default_rng(1)
    features = rng.normal(size=(4, 5, 3)).astype(np.float32)
    shares = rng.random((6, 4, 5)).astype(np.float32) * (rng.random((6, 4, 5)) < 0.3)
    shares[2] = 0
    scores = rng.random(6).astype(np.float32)
    expected = features.astype(np.float64).copy()
    means = [(s[..., None] * features).sum(axis=(0, 1)) / max(s.sum(), 1e-9) for s in shares]
    for i in range(4):
        for j in range(5):
            weights = scores * shares[:, i, j]
            if weights.sum() > 0:
                expected[i, j] = sum(w * m for w, m in zip(weights, means, strict=True)) / weights.sum()
    assert pool_masks(features, shares, scores) == pytest.approx(expected, abs=1e-5)


def test_lacking_and_mistaken_models_are_reported(folders: dict[str, str]) -> None:
    with pytest.raises(ModelError, match=r"language\.trident\.sam is empty"):
        trident.load(trident.Options(**{**folders, "sam": ""}))
    with pytest.raises(
        ModelError, match=r"language\.trident\.dino needs a model of kind backbone, but .* is of kind sam"
    ):
        trident.load(trident.Options(**{**folders, "dino": folders["sam"]}))
    with pytest.raises(ConfigError, match="'points' must be from 0 to 64"):
        trident.Options(points=100)
