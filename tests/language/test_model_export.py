"""Checkpoints become model packages: OpenCLIP's format against a plain network, transformers' by the command."""

from __future__ import annotations

import inspect
import json
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import tiny_models
import torch
from command_line import refused, run
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional as F

from freeocc3d.core.errors import ModelError
from freeocc3d.language import model_packages
from freeocc3d.language.encoders import clip
from freeocc3d.language.model_export import package_writer
from freeocc3d.language.model_export.checkpoint_files import read_checkpoint
from freeocc3d.language.model_export.package_writer import write_package
from freeocc3d.language.model_export.tokenizer_files import end_token
from freeocc3d.language.text_networks import TextNetwork

WIDTH, DIMENSION, LENGTH = 32, 24, 77


class QuickGelu(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return x * torch.sigmoid(1.702 * x)


class Block(nn.Module):
    """A residual attention block with the names that OpenAI's CLIP gave its weights."""

    def __init__(self, width: int, heads: int, act: nn.Module):
        super().__init__()
        self.attn, self.ln_1 = nn.MultiheadAttention(width, heads, batch_first=True), nn.LayerNorm(width)
        self.mlp = nn.ModuleDict(
            {"c_fc": nn.Linear(width, 4 * width), "act": act, "c_proj": nn.Linear(4 * width, width)}
        )
        self.ln_2 = nn.LayerNorm(width)

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        y = self.ln_1(x)
        x = x + self.attn(y, y, y, need_weights=False, attn_mask=mask)[0]
        return x + self.mlp["c_proj"](self.mlp["act"](self.mlp["c_fc"](self.ln_2(x))))


class OpenClip(nn.Module):
    """OpenAI's CLIP as OpenCLIP stores it."""

    def __init__(self, act: nn.Module):
        super().__init__()
        tokens = len(tiny_models.vocabulary()[0])
        self.visual = nn.Module()
        self.visual.conv1 = nn.Conv2d(3, WIDTH, 8, 8, bias=False)
        self.visual.class_embedding = nn.Parameter(torch.zeros(WIDTH))
        self.visual.positional_embedding = nn.Parameter(torch.zeros(17, WIDTH))
        self.visual.ln_pre, self.visual.ln_post = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.visual.transformer = nn.Module()
        self.visual.transformer.resblocks = nn.ModuleList(Block(WIDTH, 4, act) for _ in range(2))
        self.visual.proj = nn.Parameter(torch.zeros(WIDTH, DIMENSION))
        self.transformer = nn.Module()
        self.transformer.resblocks = nn.ModuleList(Block(16, 2, act) for _ in range(2))
        self.token_embedding = nn.Embedding(tokens, 16)
        self.positional_embedding = nn.Parameter(torch.zeros(LENGTH, 16))
        self.ln_final = nn.LayerNorm(16)
        self.text_projection = nn.Parameter(torch.zeros(16, DIMENSION))
        self.logit_scale = nn.Parameter(torch.tensor(np.log(100.0), dtype=torch.float32))

    def encode_image(self, image: Tensor) -> Tensor:
        own = self.visual
        x = own.conv1(image).flatten(2).transpose(1, 2)
        x = torch.cat((own.class_embedding.expand(len(x), 1, -1), x), dim=1) + own.positional_embedding
        x = own.ln_pre(x)
        for block in own.transformer.resblocks:
            x = block(x)
        return own.ln_post(x[:, 0]) @ own.proj

    def encode_text(self, tokens: Tensor) -> Tensor:
        length = tokens.shape[1]
        x = self.token_embedding(tokens) + self.positional_embedding[:length]
        mask = torch.full((length, length), float("-inf")).triu(1)
        for block in self.transformer.resblocks:
            x = block(x, mask)
        return self.ln_final(x)[torch.arange(len(x)), tokens.argmax(dim=-1)] @ self.text_projection


def open_clip(quick: bool) -> OpenClip:
    with tiny_models.seeded(4):
        return tiny_models.lively(OpenClip(QuickGelu() if quick else nn.GELU()))


def write_tokenizer(folder: Path) -> None:
    """CLIP's two files."""
    vocabulary, merges = tiny_models.vocabulary()
    (folder / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "merges.txt").write_text("#version: 0.2\n" + "\n".join(" ".join(pair) for pair in merges) + "\n")


def write_open_clip(folder: Path, quick: bool) -> Path:
    folder.mkdir()
    config = {
        "model_cfg": {
            "embed_dim": DIMENSION,
            "quick_gelu": quick,
            "vision_cfg": {"image_size": 32, "layers": 2, "width": WIDTH, "head_width": 8, "patch_size": 8},
            "text_cfg": {
                "context_length": LENGTH, "vocab_size": len(tiny_models.vocabulary()[0]), "width": 16, "heads": 2,
                "layers": 2,
            },
        },
        "preprocess_cfg": {"mean": [0.5, 0.4, 0.3], "std": [0.2, 0.2, 0.2]},
    }  # fmt: skip
    (folder / "open_clip_config.json").write_text(json.dumps(config))
    state = {name: value.contiguous() for name, value in open_clip(quick).state_dict().items()}
    save_file(state, folder / "open_clip_model.safetensors")
    write_tokenizer(folder)
    return folder


@pytest.mark.parametrize("quick", [True, False])
def test_open_clip_checkpoints_equal_their_own_forward_pass(tmp_path: Path, quick: bool) -> None:
    source = write_open_clip(tmp_path / "source", quick)
    write_package(read_checkpoint(str(source), None, None, None), tmp_path / "m", "m", "s", "l")
    package = model_packages.read_package(tmp_path / "m")
    assert (package.dimension, package.mean, package.logit_scale) == (24, (0.5, 0.4, 0.3), pytest.approx(100, abs=0.01))
    given = np.random.default_rng(0).normal(size=(2, 3, 32, 32)).astype(np.float32)
    words = TextNetwork(package)
    texts = ["a red chair", "椅子 " * 100, ""]
    with torch.no_grad():
        image = open_clip(quick).encode_image(torch.from_numpy(given)).numpy()
        text = F.normalize(open_clip(quick).encode_text(torch.from_numpy(words.tokens(texts))), dim=-1).numpy()
    assert np.abs(clip.load(clip.Options(model=str(tmp_path / "m"))).pooled(given) - image).max() < 1e-4
    assert np.abs(words.embed(texts) - text).max() < 1e-4


def test_the_command_exports_a_clip_of_transformers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FREEOCC3D_MODELS", str(tmp_path / "models"))
    source = tmp_path / "source"
    tiny_models.clip().save_pretrained(source)
    write_tokenizer(source)
    (source / "README.md").write_text("---\nlicense: mit\n---\n# A model\n")
    said = run("models", "export", source, "-o", "tiny", "--precision", "int8").stdout
    assert "clip, 24 dimensions, int8" in said
    package = model_packages.read_package(tmp_path / "models" / "tiny")
    model_packages.verify_files(package)
    assert (package.licence, package.source, package.input_size) == ("mit", str(source), 32)
    assert "exists: choose another" in refused("models", "export", source, "-o", tmp_path / "models" / "tiny")


def test_weights_too_large_for_one_file_lie_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(package_writer, "LARGEST", 0)
    monkeypatch.setattr(package_writer, "write_onnx", inspect.unwrap(package_writer.write_onnx))
    tiny_models.dinov2().save_pretrained(tmp_path / "source")
    write_package(read_checkpoint(str(tmp_path / "source"), None, None, None), tmp_path / "m", "m", "s", "l")
    package = model_packages.read_package(tmp_path / "m")
    assert set(package.files) == {"image.onnx", "image.onnx.data"}
    sizes = {"fp32": (tmp_path / "m" / "image.onnx.data").stat().st_size}
    given = torch.randn(2, 3, 21, 42)
    found = {"fp32": package.session("image").run(["features"], {"image": given.numpy()})[0]}
    for precision in ("fp16", "int8"):
        path = tmp_path / precision / "image.onnx"
        path.parent.mkdir()
        package_writer.change_precision(tmp_path / "m" / "image.onnx", path, precision, large=True)
        sizes[precision] = path.with_name("image.onnx.data").stat().st_size
        (found[precision],) = onnxruntime.InferenceSession(path).run(["features"], {"image": given.numpy()})
    assert sizes["fp32"] > sizes["fp16"] > sizes["int8"] > 10_000
    with torch.no_grad():
        expected = tiny_models.dinov2()(given).last_hidden_state[:, 1:].reshape(found["fp32"].shape).numpy()
    for precision, tolerance in (("fp32", 1e-4), ("fp16", 2e-2), ("int8", 0.5)):
        assert np.abs(found[precision] - expected).max() < tolerance


def test_dino_and_dinov2_checkpoints_are_backbones(tmp_path: Path) -> None:
    from transformers import ViTConfig, ViTModel

    sizes = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4, "intermediate_size": 64}
    with tiny_models.seeded(5):
        vit = tiny_models.lively(ViTModel(ViTConfig(**sizes, image_size=32, patch_size=8)))
    for name, model, patch in (("dino", vit, 8), ("dinov2", tiny_models.dinov2(), 7)):
        model.save_pretrained(tmp_path / name)
        made = tmp_path / f"{name}.model"
        checkpoint = read_checkpoint(str(tmp_path / name), None, None, None)
        write_package(checkpoint, made, name, "s", "l")
        given = np.random.default_rng(1).normal(size=(2, 3, 3 * patch, 6 * patch)).astype(np.float32)
        (features,) = model_packages.read_package(made).session("image").run(["features"], {"image": given})
        options = {"interpolate_pos_encoding": True} if name == "dino" else {}
        with torch.no_grad():
            expected = model(torch.from_numpy(given), **options).last_hidden_state[:, 1:].numpy()
        assert features.shape == (2, 3, 6, 32)
        assert np.abs(features.reshape(expected.shape) - expected).max() < 1e-4


def test_sam_equals_transformers_forward_pass(tmp_path: Path) -> None:
    tiny_models.sam().save_pretrained(tmp_path / "source")
    checkpoint = read_checkpoint(str(tmp_path / "source"), None, None, None)
    write_package(checkpoint, tmp_path / "m", "m", "s", "l")
    package = model_packages.read_package(tmp_path / "m")
    given, points = torch.randn(1, 3, 64, 64), 64 * torch.rand(1, 7, 1, 2)
    features, attention = package.session("image").run(["features", "attention"], {"image": given.numpy()})
    masks, scores = package.session("masks").run(
        ["masks", "scores"], {"features": features, "points": points[:, :, 0].numpy()}
    )
    with torch.no_grad():
        expected = tiny_models.sam()(pixel_values=given, input_points=points, multimask_output=True)
    assert np.abs(masks - expected.pred_masks.numpy()).max() < 1e-3
    assert np.abs(scores - expected.iou_scores.numpy()).max() < 1e-4
    assert attention.sum(axis=-1) == pytest.approx(1, abs=1e-5)


def test_what_is_no_checkpoint_is_reported(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"model_type": "bert"}')
    assert "does not contain a checkpoint of CLIP, SigLIP, DINO" in refused(
        "models", "export", tmp_path, "-o", tmp_path / "x"
    )
    assert not (tmp_path / "x").exists()


def test_weights_that_are_pickled_are_not_read(tmp_path: Path) -> None:
    tiny_models.dinov2().save_pretrained(tmp_path)
    torch.save({}, tmp_path / "pytorch_model.bin")
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(ModelError, match="does not contain a checkpoint"):
        read_checkpoint(str(tmp_path), None, None, None)


def test_a_tokenizer_that_is_lacking_is_reported(tmp_path: Path) -> None:
    tiny_models.clip().save_pretrained(tmp_path)
    with pytest.raises(ModelError, match=r"has neither tokenizer\.json nor vocab.json"):
        read_checkpoint(str(tmp_path), None, None, None)


def test_open_clip_weights_that_do_not_fit_are_reported(tmp_path: Path) -> None:
    source = write_open_clip(tmp_path / "source", quick=True)
    save_file({"logit_scale": torch.zeros(())}, source / "open_clip_model.safetensors")
    with pytest.raises(ModelError, match="is not a usual OpenCLIP ViT"):
        read_checkpoint(str(source), None, None, None)


@pytest.mark.parametrize("stated", [2, None])
def test_the_end_token_of_first_configurations_is_the_largest(stated: int | None) -> None:
    end = tiny_models.vocabulary()[0][tiny_models.END]
    assert end_token(end if stated is None else stated, tiny_models.tokenizer()) == end
