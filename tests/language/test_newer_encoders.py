"""Encoders that transformers does not have, exported from weights with their published names, against plain ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import tiny_models
import torch
from safetensors.torch import save_file
from test_model_export import write_tokenizer
from torch import Tensor, nn
from torch.nn import functional as F

from freeocc3d.core.errors import ModelError
from freeocc3d.language.model_export import package_writer
from freeocc3d.language.model_export.checkpoint_files import read_checkpoint
from freeocc3d.language.model_export.checkpoint_networks import Checkpoint


def assert_exported(made: Checkpoint, path: Path, given: Tensor, expected: Tensor) -> None:
    """The image network of a package gives the same, for images of another size than those it was exported with."""
    package_writer.write_onnx(made.networks["image"], path)
    (features,) = onnxruntime.InferenceSession(path).run(["features"], {"image": given.numpy()})
    assert np.abs(features - expected.numpy()).max() < 1e-4


def save(model: nn.Module, path: Path, prefix: str = "") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({prefix + name: value.contiguous() for name, value in model.state_dict().items()}, path)


def images(height: int, width: int) -> Tensor:
    with tiny_models.seeded(1):
        return torch.randn(2, 3, height, width)


def tree(**parts: Any) -> nn.Module:
    """Modules and parameters by name, and by names with dots."""
    made = nn.Module()
    for name, part in parts.items():
        *outer, last = name.split("__")
        at = made
        for step in outer:
            if not hasattr(at, step):
                at.add_module(step, nn.Module())
            at = getattr(at, step)
        setattr(at, last, part)
    return made


def attention(x: Tensor, qkv: nn.Linear, heads: int, causal: bool = False) -> Tensor:
    """Softmax attention written out, before the projection."""
    batch, tokens, width = x.shape
    q, k, v = qkv(x).reshape(batch, tokens, 3, heads, width // heads).permute(2, 0, 3, 1, 4)
    logits = q @ k.transpose(-1, -2) / (width // heads) ** 0.5
    if causal:
        logits = logits + torch.full((tokens, tokens), float("-inf")).triu(1)
    return (logits.softmax(dim=-1) @ v).transpose(1, 2).reshape(batch, tokens, width)


def dino_txt_block(width: int) -> nn.Module:
    return tree(
        norm1=nn.LayerNorm(width), attn__qkv=nn.Linear(width, 3 * width, bias=False),
        attn__proj=nn.Linear(width, width), ls1__gamma=nn.Parameter(torch.ones(width)), norm2=nn.LayerNorm(width),
        mlp__w1=nn.Linear(width, 64), mlp__w2=nn.Linear(width, 64), mlp__w3=nn.Linear(64, width),
        ls2__gamma=nn.Parameter(torch.ones(width)),
    )  # fmt: skip


def dino_txt_head(width: int) -> nn.Module:
    with tiny_models.seeded(11):
        blocks = nn.ModuleList(dino_txt_block(width) for _ in range(2))
        return tiny_models.lively(tree(block_list=blocks, ln_final=nn.LayerNorm(width)))


def dino_txt_patches(tokens: Tensor, head: nn.Module, heads: int) -> Tensor:
    x = tokens
    for own in head.block_list:
        x = x + own.ls1.gamma * own.attn.proj(attention(own.norm1(x), own.attn.qkv, heads))
        y = own.norm2(x)
        x = x + own.ls2.gamma * own.mlp.w3(F.silu(own.mlp.w1(y)) * own.mlp.w2(y))
    return head.ln_final(x)


def dino_txt_words(width: int = 128, dimension: int = 64) -> nn.Module:
    tokens = len(tiny_models.vocabulary()[0])
    blocks = nn.ModuleList(
        tree(
            attention_norm=nn.LayerNorm(width), attention__qkv=nn.Linear(width, 3 * width, bias=False),
            attention__proj=nn.Linear(width, width), ffn_norm=nn.LayerNorm(width),
            feed_forward__fc1=nn.Linear(width, 2 * width), feed_forward__fc2=nn.Linear(2 * width, width),
        )
        for _ in range(2)
    )  # fmt: skip
    with tiny_models.seeded(12):
        return tiny_models.lively(
            tree(
                backbone__token_embedding=nn.Embedding(tokens, width),
                backbone__positional_embedding=nn.Parameter(torch.zeros(77, width)), backbone__blocks=blocks,
                backbone__ln_final=nn.LayerNorm(width), head__linear_projection=nn.Linear(width, dimension, bias=False),
            )
        )  # fmt: skip


def dino_txt_text(tokens: Tensor, model: nn.Module) -> Tensor:
    own = model.backbone
    x = own.token_embedding(tokens) + own.positional_embedding[: tokens.shape[1]]
    for block in own.blocks:
        x = x + block.attention.proj(attention(block.attention_norm(x), block.attention.qkv, 2, causal=True))
        x = x + block.feed_forward.fc2(F.gelu(block.feed_forward.fc1(block.ffn_norm(x))))
    last = own.ln_final(x)[torch.arange(len(x)), tokens.argmax(dim=-1)]
    return model.head.linear_projection(last)[:, 32:]


def dinov3() -> Any:
    from transformers import DINOv3ViTConfig, DINOv3ViTModel

    with tiny_models.seeded(13):
        config = DINOv3ViTConfig(
            hidden_size=32, num_hidden_layers=2, num_attention_heads=4, intermediate_size=64, image_size=32,
            patch_size=8, num_register_tokens=2,
        )  # fmt: skip
        return tiny_models.lively(DINOv3ViTModel(config))


@pytest.mark.parametrize("version", [2, 3])
def test_dino_txt_equals_its_forward_pass(tmp_path: Path, version: int) -> None:
    model, patch = (tiny_models.dinov2(registers=2), 7) if version == 2 else (dinov3(), 8)
    model.save_pretrained(tmp_path / "dino")
    head, words = dino_txt_head(32), dino_txt_words()
    save(head, tmp_path / "txt" / "vision_head.safetensors", "" if version == 2 else "visual_model.head.")
    save(words, tmp_path / "txt" / "text_encoder.safetensors", "" if version == 2 else "text_model.")
    if version == 3:
        save_file({"logit_scale": torch.tensor([4.0])}, tmp_path / "txt" / "scale.safetensors")
    write_tokenizer(tmp_path / "txt")
    made = read_checkpoint(str(tmp_path / "dino"), None, str(tmp_path / "txt"), None)
    assert (made.kind, made.facts["dimension"], made.facts["patch"]) == ("dense", 32, patch)
    assert made.facts["logit_scale"] == pytest.approx(1 / 0.07 if version == 2 else np.exp(4.0), rel=1e-4)
    given, tokens = images(3 * patch, 6 * patch), torch.tensor([[3, 1, 9, 0], [2, 7, 0, 0]])
    tokens[0, 3] = tokens[1, 2:] = len(tiny_models.vocabulary()[0]) - 1
    with torch.no_grad():
        features, text = made.networks["image"].module(given), made.networks["text"].module(tokens)
        seen = dino_txt_patches(model(given).last_hidden_state, head, 4)[:, 3:].reshape(2, 3, 6, 32)
        assert torch.allclose(features, seen, atol=1e-4)
        assert torch.allclose(text, dino_txt_text(tokens, words), atol=1e-4)
    if version == 3:
        assert_exported(made, tmp_path / "image.onnx", given, seen)


def test_weights_of_another_dino_txt_are_refused(tmp_path: Path) -> None:
    tiny_models.dinov2(registers=2).save_pretrained(tmp_path / "dino")
    with pytest.raises(ModelError, match=r"does not contain dino\.txt's vision head"):
        read_checkpoint(str(tmp_path / "dino"), None, str(tmp_path / "dino"), None)
    head = dino_txt_head(32)
    head.extra = nn.Linear(2, 2)
    save(head, tmp_path / "txt" / "head.safetensors")
    save(dino_txt_words(), tmp_path / "txt" / "text.safetensors")
    write_tokenizer(tmp_path / "txt")
    with pytest.raises(ModelError, match=r"usual weights of dino\.txt for this DINO: .*nothing uses extra"):
        read_checkpoint(str(tmp_path / "dino"), None, str(tmp_path / "txt"), None)
