"""Splits a checkpoint into the parts of a model package: networks with inputs and outputs, and the manifest's facts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from tokenizers import Tokenizer
from torch import Tensor, nn

from . import transformer_graphs as graphs
from .tokenizer_files import clip_tokenizer, end_token, siglip_tokenizer

CLIP_MEAN, CLIP_STD = [0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.26130258, 0.27577711]
"""Mean and standard deviation of CLIP's training images."""

DINO_MEAN, DINO_STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
"""ImageNet's."""

SIGLIP_VOCABULARY = 32_000
"""Tokens of SigLIP; SigLIP 2 has more."""

_TALK2DINO_TEMPERATURE = 0.07
"""Softmax temperature in the training of Talk2DINO."""


@dataclass(frozen=True)
class CheckpointNetwork:
    """A module to export: example inputs by name, their axes with any length, and the names of its outputs."""

    module: nn.Module
    inputs: dict[str, Tensor]
    dynamic: dict[str, tuple[int, ...]]
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class Checkpoint:
    """What to export: networks by part, the tokenizer as JSON, and the manifest's facts."""

    kind: str
    networks: dict[str, CheckpointNetwork]
    facts: dict[str, Any]
    tokenizer: str | None = None


def build_clip(model: nn.Module, tokenizer: str, mean: list[float], std: list[float]) -> Checkpoint:
    """From transformers' CLIPModel; ``clip_tokenizer`` made its tokenizer.json."""
    text, vision = model.config.text_config, model.config.vision_config
    network = graphs.ClipText(model, end_token(text.eos_token_id, tokenizer))
    tokens = torch.zeros((2, 7), dtype=torch.int64)
    return Checkpoint(
        "clip",
        {**_image_networks(model, graphs.ClipHead(model)), "text": text_network(network, tokens, (0, 1))},
        _facts(model.config.projection_dim, mean, std, vision, 1, math.exp(model.logit_scale.item())),
        clip_tokenizer(tokenizer, text.max_position_embeddings),
    )


def build_siglip(
    model: nn.Module, tokenizer: str, mean: list[float], std: list[float], punctuation: bool | None = None
) -> Checkpoint:
    """From transformers' SiglipModel (SigLIP, SigLIP 2 of a fixed size) or Siglip2Model (NaFlex). punctuation: whether
    words keep it; None = as in SigLIP or SigLIP 2."""
    text, vision = model.config.text_config, model.config.vision_config
    tokens = torch.zeros((2, text.max_position_embeddings), dtype=torch.int64)
    words = text_network(graphs.SiglipText(model), tokens, (0,))
    second = text.vocab_size > SIGLIP_VOCABULARY
    stated = Tokenizer.from_str(tokenizer).token_to_id("<pad>") if second else None  # config.json states SigLIP's
    pad = text.pad_token_id if stated is None else stated
    keeps = second if punctuation is None else punctuation
    return Checkpoint(
        "clip",
        {**_image_networks(model, graphs.SiglipHead(model)), "text": words},
        _facts(vision.hidden_size, mean, std, vision, 0, math.exp(model.logit_scale.item())),
        siglip_tokenizer(tokenizer, text.max_position_embeddings, pad, without_punctuation=not keeps),
    )  # fmt: skip


def build_backbone(model: nn.Module, mean: list[float], std: list[float]) -> Checkpoint:
    """From transformers' ViTModel (DINO), Dinov2Model, with registers or without, or DINOv3ViTModel."""
    patches = graphs.Dinov3Patches if model.config.model_type == "dinov3_vit" else graphs.DinoPatches
    network = patch_network(patches(model), model.config.patch_size)
    facts = _facts(model.config.hidden_size, mean, std, model.config, 0, 1.0)
    return Checkpoint("backbone", {"image": network}, facts)


def build_text_aligned(model: nn.Module, text_model: nn.Module, tokenizer: str, head: dict[str, Tensor]) -> Checkpoint:
    """From a DINOv2; ``head`` brings a CLIP's words into its patch space, as Talk2DINO's head does."""
    seen = build_backbone(model, DINO_MEAN, DINO_STD)
    text = text_model.config.text_config
    network = graphs.ClipText(text_model, end_token(text.eos_token_id, tokenizer), graphs.Talk2DinoHead(head))
    tokens = torch.zeros((2, 7), dtype=torch.int64)
    return Checkpoint(
        "dense",
        {**seen.networks, "text": text_network(network, tokens, (0, 1))},
        {**seen.facts, "logit_scale": 1 / _TALK2DINO_TEMPERATURE},
        clip_tokenizer(tokenizer, text.max_position_embeddings),
    )


def build_sam(model: nn.Module, mean: list[float], std: list[float]) -> Checkpoint:
    """From transformers' SamModel with "eager" attention, which returns its attention weights."""
    vision = model.config.vision_config
    side, grid = vision.image_size, vision.image_size // vision.patch_size
    features = torch.zeros((1, vision.output_channels, grid, grid))
    points = torch.zeros((1, 5, 2))
    return Checkpoint(
        "sam",
        {
            "image": CheckpointNetwork(
                graphs.SamImage(model), {"image": torch.zeros((1, 3, side, side))}, {}, ("features", "attention")
            ),
            "masks": CheckpointNetwork(
                graphs.SamMasks(model), {"features": features, "points": points}, {"points": (1,)}, ("masks", "scores")
            ),
        },
        _facts(vision.output_channels, mean, std, vision, 0, 1.0),
    )


def _image(patch: int) -> Tensor:
    return torch.zeros((2, 3, 3 * patch, 5 * patch))


def patch_network(module: nn.Module, patch: int) -> CheckpointNetwork:
    """From images to features of patches."""
    return CheckpointNetwork(module, {"image": _image(patch)}, {"image": (0, 2, 3)}, ("features",))


def _image_networks(model: nn.Module, head: nn.Module) -> dict[str, CheckpointNetwork]:
    config = model.config.vision_config
    trunk, image = graphs.ImageTrunk(model.vision_model), _image(config.patch_size)
    stream = torch.zeros((2, 11, config.hidden_size))
    return {
        "image": CheckpointNetwork(
            trunk, {"image": image}, {"image": (0, 2, 3)}, ("queries", "keys", "values", "stream")
        ),
        "head": CheckpointNetwork(
            head, {"mixed": stream, "stream": stream.clone()}, {"mixed": (0, 1), "stream": (0, 1)},
            ("features", "reduced", "pooled"),
        ),
    }  # fmt: skip


def text_network(module: nn.Module, tokens: Tensor, dynamic: tuple[int, ...]) -> CheckpointNetwork:
    """From tokens to features of texts."""
    return CheckpointNetwork(module, {"tokens": tokens}, {"tokens": dynamic}, ("features",))


def _facts(
    dimension: int, mean: list[float], std: list[float], vision: Any, prefix: int, logit_scale: float
) -> dict[str, Any]:
    return {
        "dimension": int(dimension), "mean": mean, "std": std, "patch": int(vision.patch_size),
        "input_size": _image_size(vision), "prefix_tokens": prefix, "logit_scale": round(logit_scale, 4),
    }  # fmt: skip


def _image_size(vision: Any) -> int:
    """Edge of the training images in pixels; that of a square one for NaFlex, which states a number of patches."""
    if hasattr(vision, "image_size"):
        return int(vision.image_size)
    return int(vision.num_patches**0.5) * int(vision.patch_size)
