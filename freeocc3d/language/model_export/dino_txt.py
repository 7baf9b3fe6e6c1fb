"""dino.txt: DINOv2 or DINOv3 with two more blocks and a text tower that was trained with them (Jose et al., DINOv2
Meets Text, CVPR 2025).

An image's embedding in training is its class token beside the mean of its patches, so the second half of a text's
embedding is in the space of patches. A published DINO has no such weights; they are in files of their own.
"""

from __future__ import annotations

import math
import re

import torch
from torch import Tensor, nn

from .checkpoint_networks import DINO_MEAN, DINO_STD, Checkpoint, build_backbone, patch_network, text_network
from .open_clip_weights import clip_text_from_open_clip
from .tokenizer_files import clip_tokenizer
from .transformer_graphs import ClipText, DinoPatches
from .vision_blocks import Block, part_of, refuse_rest, take_linear, take_norm

_EPSILON = 1e-5
_HEAD_WIDTH = 64
_FIRST_TEMPERATURE = 0.07
"""With it training began. The files for DINOv2 do not have what it ended with."""

_TEXT_NAMES = (
    (r"attention_norm\.", "ln_1."), (r"ffn_norm\.", "ln_2."), (r"attention\.qkv\.", "attn.in_proj_"),
    (r"attention\.proj\.", "attn.out_proj."), (r"feed_forward\.fc1\.", "mlp.c_fc."),
    (r"feed_forward\.fc2\.", "mlp.c_proj."), (r"^blocks\.", "transformer.resblocks."),
)  # fmt: skip
"""dino.txt's names of weights -> OpenCLIP's."""


class DinoTxtPatches(nn.Module):
    """Patch features (B, h, w, D) in the space of the second half of a text's embedding."""

    def __init__(self, dino: DinoPatches, state: dict[str, Tensor], heads: int):
        super().__init__()
        self.dino = dino
        count = len({name.split(".")[1] for name in state if name.startswith("block_list.")})
        self.blocks = nn.ModuleList(Block(part_of(state, f"block_list.{n}."), heads, _EPSILON) for n in range(count))
        self.norm = take_norm(state, "ln_final", _EPSILON)
        projected = "linear_projection.weight" in state
        self.project = take_linear(state, "linear_projection") if projected else nn.Identity()

    def forward(self, image: Tensor) -> Tensor:
        x, grid = self.dino.tokens(image)
        for block in self.blocks:
            x = block(x)
        return self.project(self.norm(x[:, self.dino.prefix :])).unflatten(1, grid)


class SecondHalf(nn.Module):
    """Of a text's embedding: what is compared with patches."""

    def forward(self, x: Tensor) -> Tensor:
        return x.chunk(2, dim=-1)[1]


def is_dino_txt(state: dict[str, Tensor]) -> bool:
    """Whether weights are those of dino.txt's vision head and text tower."""
    return any("block_list." in name for name in state) and any("backbone.token_embedding" in name for name in state)


def build_dino_txt(model: nn.Module, state: dict[str, Tensor], tokenizer: str) -> Checkpoint:
    """From transformers' Dinov2WithRegistersModel or DINOv3ViTModel, and the weights of dino.txt's vision head and text
    tower: DINOv2's are in two files, DINOv3's in one. Raises KeyError for other weights."""
    state = {re.sub(r"^(visual_model\.head|text_model)\.", "", name): value for name, value in state.items()}
    seen = build_backbone(model, DINO_MEAN, DINO_STD)
    text = _text(state)
    image = DinoTxtPatches(seen.networks["image"].module, state, model.config.num_attention_heads)
    scale = state.pop("logit_scale", torch.tensor(math.log(1 / _FIRST_TEMPERATURE))).exp().item()
    refuse_rest(state)
    facts = {**seen.facts, "dimension": text.project.out_features // 2, "logit_scale": round(scale, 4)}
    words = text_network(text, torch.zeros((2, 7), dtype=torch.int64), (0, 1))
    networks = {"image": patch_network(image, model.config.patch_size), "text": words}
    return Checkpoint("dense", networks, facts, clip_tokenizer(tokenizer, len(text.table)))


def _text(state: dict[str, Tensor]) -> ClipText:
    """The text tower, taken out of the weights."""
    own = part_of(state, "backbone.")
    for pattern, name in _TEXT_NAMES:
        own = {re.sub(pattern, name, key): value for key, value in own.items()}
    for name in [key for key in own if key.endswith("in_proj_weight")]:
        own.setdefault(name.replace("weight", "bias"), torch.zeros(len(own[name])))
    own["text_projection"] = state.pop("head.linear_projection.weight").T
    vocabulary, width = own["token_embedding.weight"].shape
    return ClipText(clip_text_from_open_clip(own, width // _HEAD_WIDTH), vocabulary - 1, SecondHalf())
