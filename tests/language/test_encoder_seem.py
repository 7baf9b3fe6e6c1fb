"""The seem encoder: masks and their embeddings become features of pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny_models
import torch
from tiny_models import frame
from torch import Tensor, nn
from torch.nn import functional as F

from freeocc3d.core.errors import ConfigError
from freeocc3d.language.encoders import seem
from freeocc3d.language.model_export.checkpoint_networks import Checkpoint, CheckpointNetwork, build_clip
from freeocc3d.language.model_export.package_writer import write_package

QUERIES = 5


class Masks(nn.Module):
    """A network of masks: queries against patch features, as mask transformers end."""

    def __init__(self) -> None:
        super().__init__()
        self.patches = nn.Conv2d(3, 16, 4, 4)
        self.queries = nn.Parameter(torch.randn(QUERIES, 16))
        self.words = nn.Linear(16, 24)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        seen = self.patches(image)
        pooled = seen.mean(dim=(2, 3))[:, None] + self.queries
        return torch.einsum("qc,bchw->bqhw", self.queries, seen), self.words(pooled)


def network() -> Masks:
    with tiny_models.seeded(11):
        return Masks().eval()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("models") / "tiny-seem"
    words = build_clip(tiny_models.clip(), tiny_models.tokenizer(), [0.5] * 3, [0.25] * 3)
    image = CheckpointNetwork(
        network(), {"image": torch.zeros(2, 3, 16, 20)}, {"image": (0, 2, 3)}, ("masks", "embeddings")
    )
    facts = {**words.facts, "patch": 4, "prefix_tokens": 0}
    parts = {"image": image, "text": words.networks["text"]}
    checkpoint = Checkpoint("masks", parts, facts, words.tokenizer)
    write_package(checkpoint, made, made.name, "random weights", "none")
    return made


@pytest.mark.parametrize("least", [0.5, 0.9])
def test_pixels_take_the_embedding_of_their_mask(folder: Path, least: float) -> None:
    shown = frame(40, 56)
    made = seem.load(seem.Options(model=str(folder), short_side=40, mask_probability=least))
    got = made.encode(shown).astype(np.float32)
    given = ((torch.from_numpy(shown.color).float() / 255 - 0.5) / 0.25).permute(2, 0, 1)[None]
    with torch.no_grad():
        masks, embeddings = network()(given)
    masks, embeddings = masks[0].sigmoid().numpy(), F.normalize(embeddings[0], dim=-1).numpy()
    assert got.shape == (10, 14, 24)
    sure = 0
    for i in range(10):
        for j in range(14):
            best = max(range(QUERIES), key=lambda q: masks[q, i, j])
            expected = embeddings[best] if masks[best, i, j] >= least else np.zeros(24)
            assert np.abs(got[i, j] - expected).max() < 1e-3
            sure += masks[best, i, j] >= least
    assert sure > 0
    assert (sure < 140) == (least == 0.9)


def test_words_are_found_again(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FREEOCC3D_MODELS", str(tmp_path))
    made = seem.load(seem.Options(model=str(folder)))
    words = seem.load_text(made.text_state())
    features = words.encode_words(["chair", "table"]).features
    assert features.shape == (2, made.dimension)
    assert np.linalg.norm(features, axis=1) == pytest.approx(1, abs=1e-5)


def test_options_out_of_range_are_reported() -> None:
    with pytest.raises(ConfigError, match="'mask_probability' must be greater than 0 and less than 1"):
        seem.Options(mask_probability=1.0)
