"""Encoders that transformers does not have, exported from weights with their published names, against plain ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import tiny_models
import torch
from safetensors.torch import save_file
from test_model_export import Block, write_tokenizer
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


RADIO_HEADS, RADIO_WIDTH, PREFIX = 6, 48, 4


def radio() -> nn.Module:
    """A ViT-S of small width with its adaptor, as in the file of weights on the hub."""
    width, out = RADIO_WIDTH, 32
    blocks = nn.ModuleList(
        tree(
            norm1=nn.LayerNorm(width, 1e-6), attn__qkv=nn.Linear(width, 3 * width), attn__proj=nn.Linear(width, width),
            norm2=nn.LayerNorm(width, 1e-6), mlp__fc1=nn.Linear(width, 2 * width), mlp__fc2=nn.Linear(2 * width, width),
        )
        for _ in range(2)
    )  # fmt: skip
    adaptor = tree(
        fc1=nn.Linear(width, 40), blocks=nn.ModuleList([nn.Sequential(nn.LayerNorm(40), nn.GELU(), nn.Linear(40, 40))]),
        final=nn.Sequential(nn.LayerNorm(40), nn.GELU(), nn.Linear(40, out)),
    )  # fmt: skip
    with tiny_models.seeded(21):
        made = tiny_models.lively(
            tree(
                model__patch_generator__embedder=nn.Linear(3 * 64, width, bias=False),
                model__patch_generator__pos_embed=nn.Parameter(torch.zeros(1, 25, width)),
                model__patch_generator__cls_token__token=nn.Parameter(torch.zeros(PREFIX, width)), model__blocks=blocks,
                adaptors=nn.ModuleDict({"siglip2-g": tree(head_mlp=adaptor, feat_mlp__fc1=nn.Linear(width, 40))}),
            )
        )  # fmt: skip
    made.input_conditioner = nn.Module()
    made.input_conditioner.register_buffer("norm_mean", torch.tensor([0.1, 0.2, 0.3])[:, None, None])
    made.input_conditioner.register_buffer("norm_std", torch.tensor([0.4, 0.5, 0.6])[:, None, None])
    return made


def recursive_attention(block: nn.Module, x: Tensor) -> Tensor:
    batch, _, width = x.shape
    once = block.attn.proj(attention(x, block.attn.qkv, RADIO_HEADS))
    v = block.attn.qkv(x).chunk(3, dim=-1)[2]
    out = torch.zeros_like(once)
    for b in range(batch):
        for head in range(RADIO_HEADS):
            own = slice(head * width // RADIO_HEADS, (head + 1) * width // RADIO_HEADS)
            unit = F.normalize(once[b, :, own], dim=-1)
            weights = 10 * unit @ unit.T
            weights[weights < 0] = -torch.inf
            out[b, :, own] = weights.softmax(dim=-1) @ v[b, :, own]
    return block.attn.proj(out)


def radio_patches(image: Tensor, own: nn.Module, height: int, width: int) -> Tensor:
    """RADSeg's features of (2, 3, 8 height, 8 width)."""
    net, mlp = own.model, own.adaptors["siglip2-g"].head_mlp
    pixels = image.reshape(2, 3, height, 8, width, 8).permute(0, 2, 4, 1, 3, 5).reshape(2, height * width, 192)
    table = net.patch_generator.pos_embed.reshape(1, 5, 5, -1).permute(0, 3, 1, 2)
    longer = max(height, width)
    table = F.interpolate(table, size=(longer, longer), mode="bilinear", align_corners=True)[..., :height, :width]
    x = net.patch_generator.embedder(pixels) + table.flatten(2).transpose(1, 2)
    x = torch.cat((net.patch_generator.cls_token.token.expand(2, -1, -1), x), dim=1)
    for n, block in enumerate(net.blocks):
        y = block.norm1(x)
        last = n == len(net.blocks) - 1
        x = x + (recursive_attention(block, y) if last else block.attn.proj(attention(y, block.attn.qkv, RADIO_HEADS)))
        x = x + block.mlp.fc2(F.gelu(block.mlp.fc1(block.norm2(x))))
    gathered = []
    for patches in x[:, PREFIX:]:
        unit = F.normalize(patches, dim=-1)
        weights = 10 * (unit @ unit.T - (unit @ unit.T).mean())
        weights[weights < 0] = -torch.inf
        gathered.append(weights.softmax(dim=-1) @ patches)
    x = mlp.fc1(torch.stack(gathered))
    for block in mlp.blocks:
        x = x + block(x)
    return mlp.final(x).reshape(2, height, width, -1)


def write_radio(folder: Path) -> nn.Module:
    model = radio()
    save(model, folder / "model.safetensors", "radio_model.")
    stated = {
        "architectures": ["RADIOModel"], "args": {"model": "vit_small_patch16_224"}, "preferred_resolution": [512, 512]
    }  # fmt: skip
    (folder / "config.json").write_text(json.dumps(stated))
    return model


def write_siglip(folder: Path) -> Any:
    model = tiny_models.siglip()
    model.save_pretrained(folder)
    (folder / "tokenizer.json").write_text(tiny_models.tokenizer())
    return model


def test_radio_equals_radsegs_forward_pass(tmp_path: Path) -> None:
    model, siglip = write_radio(tmp_path / "radio"), write_siglip(tmp_path / "siglip")
    made = read_checkpoint(str(tmp_path / "radio"), None, str(tmp_path / "siglip"), None)
    facts = made.facts
    assert (made.kind, facts["dimension"], facts["patch"], facts["input_size"]) == ("dense", 32, 8, 512)
    assert facts["mean"] + facts["std"] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    assert facts["logit_scale"] == pytest.approx(np.exp(siglip.logit_scale.item()), rel=1e-3)
    with torch.no_grad():
        for size in ((3, 6), (7, 4), (5, 5)):
            given = images(8 * size[0], 8 * size[1])
            seen = radio_patches(given, model, *size)
            assert torch.allclose(made.networks["image"].module(given), seen, atol=1e-4)
    assert_exported(made, tmp_path / "image.onnx", given, seen)


def test_what_a_radio_lacks_is_reported(tmp_path: Path) -> None:
    model = write_radio(tmp_path)
    with pytest.raises(ModelError, match="name that with --text"):
        read_checkpoint(str(tmp_path), None, None, None)
    write_siglip(tmp_path / "siglip")
    for change, said in ((lambda: setattr(model.model.blocks[0], "ls1", nn.Linear(2, 2)), "nothing uses"),
                         (lambda: delattr(model, "adaptors"), "without an adaptor for words")):  # fmt: skip
        change()
        save(model, tmp_path / "model.safetensors", "radio_model.")
        with pytest.raises(ModelError, match=said):
            read_checkpoint(str(tmp_path), None, str(tmp_path / "siglip"), None)


def perception_encoder(width: int, heads: int, named: bool, scaled: bool) -> nn.Module:
    """A Perception Encoder's image tower with two blocks; named: with a class token and what leads to words."""
    with tiny_models.seeded(31):
        made = tree(
            conv1=nn.Conv2d(3, width, 8, 8, bias=False), ln_pre=nn.LayerNorm(width),
            positional_embedding=nn.Parameter(torch.zeros(16 + named, width)),
            transformer__resblocks=nn.ModuleList(Block(width, heads, nn.Identity()) for _ in range(2)),
        )  # fmt: skip
        for block in made.transformer.resblocks if scaled else ():
            block.ls_1 = tree(gamma=nn.Parameter(torch.ones(width)))
            block.ls_2 = tree(gamma=nn.Parameter(torch.ones(width)))
        if named:
            made.class_embedding, made.ln_post = nn.Parameter(torch.zeros(width)), nn.LayerNorm(width)
            mlp = tree(c_fc=nn.Linear(width, 2 * width), c_proj=nn.Linear(2 * width, width))
            pool = nn.MultiheadAttention(width, 8, batch_first=True)
            made.attn_pool = tree(
                attn=pool, layernorm=nn.LayerNorm(width), mlp=mlp, probe=nn.Parameter(torch.zeros(1, 1, width))
            )  # fmt: skip
            made.proj = nn.Parameter(torch.zeros(width, 16))
        return tiny_models.lively(made)


def turned(x: Tensor, height: int, width: int, prefix: int) -> Tensor:
    """Pairs of channels of (B, heads, N, d) as complex numbers, turned by their patch's place."""
    quarter = x.shape[-1] // 4
    out = torch.view_as_complex(x.reshape(*x.shape[:-1], -1, 2)).clone()
    for row in range(height):
        for column in range(width):
            for n in range(quarter):
                speed = 10_000.0 ** (-n / quarter)
                at = prefix + row * width + column
                out[:, :, at, n] *= np.exp(1j * speed * (column + prefix))
                out[:, :, at, quarter + n] *= np.exp(1j * speed * (row + prefix))
    return torch.view_as_real(out).flatten(-2)


def perception_tokens(image: Tensor, own: nn.Module, heads: int) -> Tensor:
    """After the last block."""
    x = own.conv1(image)
    height, width = x.shape[-2:]
    prefix = len(own.positional_embedding) - 16
    table = own.positional_embedding[prefix:].reshape(1, 4, 4, -1).permute(0, 3, 1, 2)
    table = F.interpolate(table, size=(height, width), mode="bilinear", align_corners=False)
    x = (x + table).flatten(2).transpose(1, 2)
    if prefix:
        first = own.class_embedding + own.positional_embedding[0]
        x = torch.cat((first.expand(len(x), 1, -1), x), dim=1)
    x = own.ln_pre(x)
    for block in own.transformer.resblocks:
        projected = F.linear(block.ln_1(x), block.attn.in_proj_weight, block.attn.in_proj_bias)
        q, k, v = (part.unflatten(-1, (heads, -1)).transpose(1, 2) for part in projected.chunk(3, dim=-1))
        q, k = turned(q, height, width, prefix), turned(k, height, width, prefix)
        mixed = (q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5).softmax(dim=-1) @ v
        x = x + scale_of(block, "ls_1") * block.attn.out_proj(mixed.transpose(1, 2).flatten(2))
        y = block.mlp["c_proj"](F.gelu(block.mlp["c_fc"](block.ln_2(x))))
        x = x + scale_of(block, "ls_2") * y
    return x


def scale_of(block: nn.Module, name: str) -> Tensor | float:
    return getattr(block, name).gamma if hasattr(block, name) else 1.0


def test_pe_core_equals_its_forward_pass(tmp_path: Path) -> None:
    words = len(tiny_models.vocabulary()[0])
    with tiny_models.seeded(32):
        model = tree(
            token_embedding=nn.Embedding(words, 16), positional_embedding=nn.Parameter(torch.zeros(32, 16)),
            transformer__resblocks=nn.ModuleList(Block(16, 8, nn.GELU()) for _ in range(2)), ln_final=nn.LayerNorm(16),
            text_projection=nn.Parameter(torch.zeros(16, 16)), logit_scale=nn.Parameter(torch.tensor(4.0)),
        )  # fmt: skip
        tiny_models.lively(model)
    model.visual = own = perception_encoder(24, 3, named=True, scaled=False)
    save(model, tmp_path / "PE-Core-T16-384.safetensors")
    write_tokenizer(tmp_path)
    made = read_checkpoint(str(tmp_path), None, None, None)
    facts = [made.facts[name] for name in ("dimension", "patch", "input_size", "prefix_tokens")]
    assert (made.kind, facts, made.facts["mean"]) == ("clip", [16, 8, 384, 1], [0.5] * 3)
    assert made.facts["logit_scale"] == pytest.approx(np.exp(4.0), rel=1e-4)
    given, tokens = images(24, 40), torch.tensor([[3, 1, 9, words - 1], [2, words - 1, 0, 0]])
    with torch.no_grad():
        q, k, v, stream = made.networks["image"].module(given)
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        features, _, pooled = made.networks["head"].module(mixed, stream)
        x = own.ln_post(perception_tokens(given, own, 3))
        assert torch.allclose(pooled, pool(x, own), atol=1e-4)
        assert torch.allclose(features[:, 5], pool(x[:, 5:6], own), atol=1e-4)
        y = model.token_embedding(tokens) + model.positional_embedding[:4]
        for block in model.transformer.resblocks:
            y = block(y, torch.full((4, 4), float("-inf")).triu(1))
        last = model.ln_final(y)[[0, 1], [3, 1]] @ model.text_projection
        assert torch.allclose(made.networks["text"].module(tokens), last, atol=1e-4)


def pool(x: Tensor, own: nn.Module) -> Tensor:
    y = own.attn_pool.attn(own.attn_pool.probe.expand(len(x), -1, -1), x, x, need_weights=False)[0]
    mlp = own.attn_pool.mlp
    return (y + mlp.c_proj(F.gelu(mlp.c_fc(own.attn_pool.layernorm(y)))))[:, 0] @ own.proj


def test_pe_spatial_is_a_backbone(tmp_path: Path) -> None:
    own = perception_encoder(64, 16, named=False, scaled=True)
    save(own, tmp_path / "PE-Spatial-G14-448.safetensors")
    made = read_checkpoint(str(tmp_path), None, None, None)
    assert (made.kind, made.facts["dimension"], made.tokenizer) == ("backbone", 64, None)
    given = images(24, 40)
    with torch.no_grad():
        seen = perception_tokens(given, own, 16).reshape(2, 3, 5, 64)
    assert_exported(made, tmp_path / "image.onnx", given, seen)
    own.extra = nn.Linear(2, 2)
    save(own, tmp_path / "PE-Spatial-G14-448.safetensors")
    with pytest.raises(ModelError, match=r"not a usual Perception Encoder: .*nothing uses extra"):
        read_checkpoint(str(tmp_path), None, None, None)
