"""RADIO, a ViT distilled from several networks, with its adaptor into SigLIP 2's space, read as RADSeg does.

RADIO: Heinrich et al., RADIOv2.5, CVPR 2025; C-RADIO v3 and v4 have the adaptors "siglip2-g" and "siglip2". RADSeg
(Alama et al., 2025) changes the last block's attention, gathers patches over the image, and projects them by the
adaptor's head for whole images, whose space is that of words, not by the one for patches.
"""

from __future__ import annotations

import re
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .checkpoint_networks import Checkpoint, build_siglip, patch_network
from .vision_blocks import Block, part_of, refuse_rest, take_linear, take_norm

_HEADS = {"tiny": 3, "small": 6, "base": 12, "large": 16, "so400m": 16, "huge": 16}
"""Size of timm's ViT -> heads of its attention."""

_EPSILON, _ADAPTOR_EPSILON = 1e-6, 1e-5

_SHARPNESS = 10.0
"""Factor of RADSeg's cosines in both of its softmaxes."""


class RadioPatches(nn.Module):
    """Patch features (B, h, w, D) in SigLIP 2's space."""

    def __init__(self, state: dict[str, Tensor], adaptor: dict[str, Tensor], heads: int):
        super().__init__()
        weight = state.pop("patch_generator.embedder.weight")
        self.patch = int((weight.shape[1] // 3) ** 0.5)
        self.patches = nn.Conv2d(3, len(weight), self.patch, self.patch, bias=False)
        self.patches.load_state_dict({"weight": weight.reshape(-1, 3, self.patch, self.patch)})
        table = state.pop("patch_generator.pos_embed")[0]
        side = int(len(table) ** 0.5)
        self.register_buffer("table", table.reshape(side, side, -1))
        self.register_buffer("first", state.pop("patch_generator.cls_token.token")[None])
        count = len({name.split(".")[1] for name in state if name.startswith("blocks.")})
        self.blocks = nn.ModuleList(Block(part_of(state, f"blocks.{n}."), heads, _EPSILON) for n in range(count))
        self.norm = take_norm(state, "norm", _EPSILON) if "norm.weight" in state else nn.Identity()
        self.adaptor = SummaryHead(adaptor)

    def forward(self, image: Tensor) -> Tensor:
        x = self.patches(image)
        height, width = x.shape[-2:]
        x = x.flatten(2).transpose(1, 2) + cropped_positions(self.table, height, width)
        x = torch.cat((self.first.expand(x.shape[0], -1, -1), x), dim=1)
        for block in self.blocks[:-1]:
            x = block(x)
        x = self.norm(attend_recursively(self.blocks[-1], x))[:, self.first.shape[1] :]
        return self.adaptor(gather_alike(x)).unflatten(1, (height, width))


class SummaryHead(nn.Module):
    """The adaptor's network for embeddings of whole images."""

    def __init__(self, state: dict[str, Tensor]):
        super().__init__()
        self.first = take_linear(state, "fc1")
        count = len({name.split(".")[1] for name in state if name.startswith("blocks.")})
        self.blocks = nn.ModuleList(_normed_linear(state, f"blocks.{n}") for n in range(count))
        self.last = _normed_linear(state, "final")

    def forward(self, x: Tensor) -> Tensor:
        x = self.first(x)
        for block in self.blocks:
            x = x + block(x)
        return self.last(x)


def _normed_linear(state: dict[str, Tensor], name: str) -> nn.Sequential:
    return nn.Sequential(
        take_norm(state, f"{name}.0", _ADAPTOR_EPSILON), nn.GELU(), take_linear(state, f"{name}.2")
    )  # fmt: skip


def cropped_positions(table: Tensor, height: int, width: int) -> Tensor:
    """(1, height width, C) of (S, S, C): resized bilinearly, corner on corner, to the longer side, and cropped. The
    weights of a bilinear interpolation are tents; as products they take any size in an exported graph."""
    side = table.shape[0]
    longer = torch.sym_max(torch.sym_max(height, width) - 1, 1)
    rows, columns = (
        (1 - (torch.arange(n, device=table.device)[:, None] * (side - 1) / longer
              - torch.arange(side, device=table.device)).abs()).clamp(min=0)
        for n in (height, width)
    )  # fmt: skip
    return torch.einsum("yi,xj,ijc->yxc", rows, columns, table).flatten(0, 1)[None]


def attend_recursively(block: Block, x: Tensor) -> Tensor:
    """A block in which the attention's output says anew what attends to what, by the cosines of its channels, a head's
    share at a time; those below zero do not count."""
    q, k, v = block.queries_keys_values(x)
    mixed = block.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
    own = F.normalize(mixed.unflatten(-1, (block.heads, -1)).transpose(1, 2), dim=-1)
    mixed = _positive_softmax(own @ own.transpose(-1, -2)) @ v
    return block.after(x, block.proj(mixed.transpose(1, 2).flatten(2)))


def gather_alike(x: Tensor) -> Tensor:
    """(B, N, C): each patch becomes a mean of those that are more like it than patches of the image are on average."""
    unit = F.normalize(x, dim=-1)
    cosines = unit @ unit.transpose(-1, -2)
    return _positive_softmax(cosines - cosines.mean(dim=(-2, -1), keepdim=True)) @ x


def _positive_softmax(x: Tensor) -> Tensor:
    return torch.where(x < 0, float("-inf"), _SHARPNESS * x).softmax(dim=-1)


def build_radio(config: dict[str, Any], state: dict[str, Tensor], siglip: nn.Module, tokenizer: str) -> Checkpoint:
    """From a RADIO as NVIDIA publishes it on the hub, and the SigLIP 2 whose words its adaptor was trained for.

    config: of config.json.  Raises KeyError for other weights, ValueError for a SigLIP 2 of another width.
    """
    state = {name.removeprefix("radio_model."): value for name, value in state.items()}
    adaptors = sorted({name.split(".")[1] for name in state if name.startswith("adaptors.siglip2")})
    if not adaptors:
        raise KeyError("adaptors.siglip2: it was saved without an adaptor for words")
    if any(name.startswith("feature_normalizer.") for name in state):
        raise KeyError("its features are normalized, which is not read yet")
    conditioner = part_of(state, "input_conditioner.")
    adaptor = part_of(state, f"adaptors.{adaptors[0]}.head_mlp.")
    backbone = part_of(state, "model.")
    size = re.fullmatch(r"vit_(\w+)_patch\d+_\d+", str(config["args"]["model"]))
    if size is None or size[1] not in _HEADS:
        raise KeyError(f"its network {config['args']['model']} is not a plain ViT")
    image = RadioPatches(backbone, adaptor, _HEADS[size[1]])
    refuse_rest({**backbone, **adaptor})
    words = build_siglip(siglip, tokenizer, [0.5] * 3, [0.5] * 3, punctuation=False)
    dimension, given = image.adaptor.last[-1].out_features, words.networks["text"].module.head.out_features
    if dimension != given:
        raise ValueError(f"its adaptor has {dimension} dimensions, but the words of that SigLIP 2 have {given}")
    mean, std = (conditioner[name].flatten().tolist() for name in ("norm_mean", "norm_std"))
    facts = {
        **words.facts, "dimension": dimension, "mean": mean, "std": std, "patch": image.patch,
        "input_size": int(config["preferred_resolution"][0]), "prefix_tokens": 0,
    }  # fmt: skip
    networks = {"image": patch_network(image, image.patch), "text": words.networks["text"]}
    return Checkpoint("dense", networks, facts, words.tokenizer)
