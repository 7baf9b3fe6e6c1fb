"""Perception Encoder (Bolya et al., 2025): PE-Core, a CLIP with turned queries and keys, and PE-Spatial, a backbone.

A PE-Core's patches are pooled by attention, as SigLIP's are. PE-Spatial is PE-Core tuned for places, without what leads
to words: its patches have a space of their own.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .checkpoint_networks import Checkpoint, CheckpointNetwork, patch_network, text_network
from .open_clip_weights import clip_text_from_open_clip
from .tokenizer_files import clip_tokenizer
from .transformer_graphs import ClipText, heads_of, positions
from .vision_blocks import Block, part_of, refuse_rest, take_linear, take_norm

_EPSILON = 1e-5
_TURN_BASE = 10_000.0
_POOLING_HEADS = 8
_NAME = re.compile(r"PE-(Core|Spatial)-([TSBLG]\d\d)-(\d+)")
_HEADS = {"T16": (3, 8), "S16": (6, 8), "B16": (12, 16), "L14": (16, 16), "G14": (16, 20)}
"""Size -> heads of the image's blocks and of the text's."""

_BLOCK_NAMES = (
    ("ln_1.", "norm1."), ("ln_2.", "norm2."), ("attn.in_proj_", "attn.qkv."), ("attn.out_proj.", "attn.proj."),
    ("mlp.c_fc.", "mlp.fc1."), ("mlp.c_proj.", "mlp.fc2."), ("ls_1.", "ls1."), ("ls_2.", "ls2."),
)  # fmt: skip
"""PE's names of weights in a block -> timm's."""


def _block(state: dict[str, Tensor], heads: int) -> Block:
    for theirs, ours in _BLOCK_NAMES:
        state = {name.replace(theirs, ours): value for name, value in state.items()}
    return Block(state, heads, _EPSILON)


class PerceptionTrunk(nn.Module):
    """All blocks but the last of a Perception Encoder, and that one's queries, keys, values and input."""

    def __init__(self, state: dict[str, Tensor], heads: int):
        super().__init__()
        weight = state.pop("conv1.weight")
        self.patch = int(weight.shape[-1])
        self.patches = nn.Conv2d(3, len(weight), self.patch, self.patch, bias=False)
        self.patches.load_state_dict({"weight": weight})
        first, table = state.pop("class_embedding", None), state.pop("positional_embedding")
        self.prefix = 0 if first is None else 1
        start = table[:0] if first is None else first + table[:1]
        self.grid = int((len(table) - self.prefix) ** 0.5)
        self.register_buffer("first", start[None])
        self.register_buffer("table", table[self.prefix :])
        self.before = take_norm(state, "ln_pre", _EPSILON)
        count = len({name.split(".")[2] for name in state if name.startswith("transformer.resblocks.")})
        made = [_block(part_of(state, f"transformer.resblocks.{n}."), heads) for n in range(count)]
        self.blocks, self.last = nn.ModuleList(made[:-1]), made[-1]
        half = len(weight) // heads // 2
        self.register_buffer("frequencies", _TURN_BASE ** -(torch.arange(0, half, 2) / half))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        x = self.patches(image)
        height, width = x.shape[-2:]
        x = x.flatten(2).transpose(1, 2) + positions(self.table, self.grid, height, width, mode="bilinear")
        x = self.before(torch.cat((self.first.expand(x.shape[0], -1, -1), x), dim=1))
        angles = self._angles(height, width)
        for block in self.blocks:
            q, k, v = block.queries_keys_values(x)
            mixed = F.scaled_dot_product_attention(turn(q, angles), turn(k, angles), v)
            x = block.after(x, block.proj(mixed.transpose(1, 2).flatten(2)))
        q, k, v = self.last.queries_keys_values(x)
        return turn(q, angles), turn(k, angles), v, x

    def _angles(self, height: int, width: int) -> Tensor:
        """(N, d / 2): of the column, then of the row; a class token is at (0, 0), and patches begin at 1 beside it."""
        rows, columns = (
            (torch.arange(n, device=self.frequencies.device) + self.prefix)[:, None] * self.frequencies
            for n in (height, width)
        )
        both = torch.cat(
            (columns[None].expand(height, -1, -1), rows[:, None].expand(-1, width, -1)), dim=-1
        ).flatten(0, 1)  # fmt: skip
        return torch.cat((both.new_zeros(self.prefix, both.shape[1]), both))


def turn(x: Tensor, angles: Tensor) -> Tensor:
    """(B, heads, N, d) with channels 2 i and 2 i + 1 turned as a point by angle i of (N, d / 2)."""
    even, odd = x[..., ::2], x[..., 1::2]
    cos, sin = angles.cos(), angles.sin()
    return torch.stack((even * cos - odd * sin, odd * cos + even * sin), dim=-1).flatten(-2)


class PerceptionHead(nn.Module):
    """The rest of a PE-Core, as a package's head. A patch's feature is the result of pooling that patch alone."""

    def __init__(self, state: dict[str, Tensor], last: Block):
        super().__init__()
        self.last, self.norm = last, take_norm(state, "ln_post", _EPSILON)
        weight, bias = state.pop("attn_pool.attn.in_proj_weight"), state.pop("attn_pool.attn.in_proj_bias")
        self.register_buffer("weight", weight)
        self.register_buffer("bias", bias)
        self.register_buffer("probe", state.pop("attn_pool.probe"))
        self.proj = take_linear(state, "attn_pool.attn.out_proj")
        self.pool_norm = take_norm(state, "attn_pool.layernorm", _EPSILON)
        self.wide, self.narrow = take_linear(state, "attn_pool.mlp.c_fc"), take_linear(state, "attn_pool.mlp.c_proj")
        self.register_buffer("project", state.pop("proj"))

    def forward(self, mixed: Tensor, stream: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        own = self.last.proj(mixed)
        x = self.norm(self.last.after(stream, own))
        return self._alone(x), self._alone(self.norm(own)), self._pooled(x)

    def _alone(self, x: Tensor) -> Tensor:
        return self._after(self._projected(x, 2))

    def _pooled(self, x: Tensor) -> Tensor:
        sides = (self.probe.expand(x.shape[0], -1, -1), x, x)
        q, k, v = (heads_of(self._projected(side, n), _POOLING_HEADS) for n, side in enumerate(sides))
        return self._after(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))[:, 0]

    def _projected(self, x: Tensor, which: int) -> Tensor:
        return F.linear(x, self.weight.chunk(3)[which], self.bias.chunk(3)[which])

    def _after(self, mixed: Tensor) -> Tensor:
        y = self.proj(mixed)
        return (y + self.narrow(F.gelu(self.wide(self.pool_norm(y))))) @ self.project


class PerceptionPatches(nn.Module):
    """Patch features (B, h, w, C) of PE-Spatial, in their own space."""

    def __init__(self, trunk: PerceptionTrunk):
        super().__init__()
        self.trunk = trunk

    def forward(self, image: Tensor) -> Tensor:
        q, k, v, x = self.trunk(image)
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        x = self.trunk.last.after(x, self.trunk.last.proj(mixed))
        grid = image.shape[2] // self.trunk.patch, image.shape[3] // self.trunk.patch
        return x[:, self.trunk.prefix :].unflatten(1, grid)


@dataclass(frozen=True)
class PerceptionFile:
    """A file of weights that its name says the network of."""

    path: Path
    purpose: str
    size: str
    side: int


def find_perception_encoder(folder: Path) -> PerceptionFile | None:
    """The weights of a Perception Encoder in a folder, by the name that they are published with; None if there are
    none."""
    for path in sorted(folder.glob("PE-*.safetensors")):
        if (found := _NAME.fullmatch(path.stem)) and found[2] in _HEADS:
            return PerceptionFile(path, found[1], found[2], int(found[3]))
    return None


def build_perception_encoder(found: PerceptionFile, state: dict[str, Tensor], tokenizer: str | None) -> Checkpoint:
    """A "clip" of a PE-Core, whose words need CLIP's tokenizer, or a "backbone" of a PE-Spatial. Raises KeyError for
    other weights."""
    image_heads, text_heads = _HEADS[found.size]
    visual = part_of(state, "visual.") or state
    trunk = PerceptionTrunk(visual, image_heads)
    facts: dict[str, Any] = {
        "mean": [0.5] * 3, "std": [0.5] * 3, "patch": trunk.patch, "input_size": found.side, "prefix_tokens": 0,
        "logit_scale": 1.0,
    }  # fmt: skip
    if tokenizer is None:
        refuse_rest(visual)
        network = patch_network(PerceptionPatches(trunk), trunk.patch)
        return Checkpoint("backbone", {"image": network}, {**facts, "dimension": trunk.first.shape[-1]})
    head = PerceptionHead(visual, trunk.last)
    refuse_rest(visual)
    scale = state.pop("logit_scale").exp().item()
    text = ClipText(clip_text_from_open_clip(state, text_heads), len(state["token_embedding.weight"]) - 1)
    stream = torch.zeros((2, 11, trunk.first.shape[-1]))
    networks = {
        "image": CheckpointNetwork(
            trunk, patch_network(trunk, trunk.patch).inputs, {"image": (0, 2, 3)},
            ("queries", "keys", "values", "stream"),
        ),
        "head": CheckpointNetwork(
            head, {"mixed": stream, "stream": stream.clone()}, {"mixed": (0, 1), "stream": (0, 1)},
            ("features", "reduced", "pooled"),
        ),
        "text": text_network(text, torch.zeros((2, 7), dtype=torch.int64), (0, 1)),
    }  # fmt: skip
    facts |= {"dimension": head.project.shape[1], "prefix_tokens": trunk.prefix, "logit_scale": round(scale, 4)}
    return Checkpoint("clip", networks, facts, clip_tokenizer(tokenizer, len(text.table)))
