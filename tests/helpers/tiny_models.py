"""Tiny networks with random weights, and their vocabulary, for the tests of model packages."""

from __future__ import annotations

import collections
import contextlib
import functools
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.language.model_export.checkpoint_networks import build_clip
from freeocc3d.language.model_export.package_writer import write_package
from freeocc3d.language.model_export.tokenizer_files import clip_tokenizer_from

CLIP_MEAN, CLIP_STD = [0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.26130258, 0.27577711]
START, END = "<|startoftext|>", "<|endoftext|>"

_CORPUS = """a photo of the small red chair in a room there is a large table by the window and the lamp on it, it's a
sofa with pillows that nobody's sitting on; they're looking at the television, we've got cabinets and shelves, i'll open
the door, he'd close it. don't scream! number 10 or 4096. das große fenster über der tür, la chaise élégante, стул и
стол, 椅子和桌子, κουζίνα, كرسي"""


def byte_characters() -> list[str]:
    """The 256 characters that stand for bytes in CLIP's vocabulary: printable ones for themselves, the others above."""
    printable = [*range(33, 127), *range(161, 173), *range(174, 256)]
    above = itertools.count(256)
    return [chr(byte) if byte in printable else chr(next(above)) for byte in range(256)]


@functools.cache
def vocabulary(n_merges: int = 400) -> tuple[dict[str, int], list[tuple[str, str]]]:
    """CLIP's kind of vocabulary and merges, learned from a few sentences."""
    characters = byte_characters()
    words = collections.Counter(
        (*(characters[b] for b in word.encode()[:-1]), characters[word.encode()[-1]] + "</w>")
        for word in _CORPUS.lower().split()
    )
    merges: list[tuple[str, str]] = []
    while len(merges) < n_merges:
        pairs: collections.Counter[tuple[str, str]] = collections.Counter()
        for word, count in words.items():
            for pair in itertools.pairwise(word):
                pairs[pair] += count
        if not pairs:
            break
        best = max(sorted(pairs), key=pairs.__getitem__)
        merges.append(best)
        words = collections.Counter({_merged(word, best): count for word, count in words.items()})
    tokens = [*characters, *(c + "</w>" for c in characters), *map("".join, merges), START, END]
    return {token: number for number, token in enumerate(dict.fromkeys(tokens))}, merges


def _merged(word: tuple[str, ...], pair: tuple[str, str]) -> tuple[str, ...]:
    out: list[str] = []
    for part in word:
        if out and (out[-1], part) == pair:
            out[-1] += part
        else:
            out.append(part)
    return tuple(out)


def tokenizer() -> str:
    return clip_tokenizer_from(*vocabulary())


def clip(dimension: int = 24, seed: int = 0) -> Any:
    """A CLIP of 3 + 2 layers with patches of 8 pixels, trained (so to speak) on images of 32."""
    from transformers import CLIPConfig, CLIPModel

    tokens = len(vocabulary()[0])
    with seeded(seed):
        model = CLIPModel(
            CLIPConfig(
                projection_dim=dimension,
                vision_config={
                    "hidden_size": 48, "intermediate_size": 96, "num_hidden_layers": 3, "num_attention_heads": 4,
                    "image_size": 32, "patch_size": 8, "projection_dim": dimension,
                },
                text_config={
                    "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4,
                    "vocab_size": tokens, "max_position_embeddings": 77, "projection_dim": dimension,
                    "bos_token_id": tokens - 2, "eos_token_id": tokens - 1, "pad_token_id": tokens - 1,
                },
            )
        )  # fmt: skip
        return lively(model)


def siglip(seed: int = 1) -> Any:
    from transformers import SiglipConfig, SiglipModel

    with seeded(seed):
        model = SiglipModel(
            SiglipConfig(
                vision_config={
                    "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4,
                    "image_size": 32, "patch_size": 8,
                },
                text_config={
                    "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4,
                    "vocab_size": len(vocabulary()[0]), "max_position_embeddings": 16, "projection_size": 32,
                    "bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1,
                },
            )
        )  # fmt: skip
        return lively(model)


def naflex(seed: int = 3) -> Any:
    """SigLIP 2 for images of any shape, as flattened patches."""
    from transformers import Siglip2Config, Siglip2Model

    sizes = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    words = {"vocab_size": len(vocabulary()[0]), "max_position_embeddings": 16, "projection_size": 32,
             "bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1}  # fmt: skip
    with seeded(seed):
        config = Siglip2Config(
            vision_config={**sizes, "patch_size": 8, "num_patches": 16}, text_config={**sizes, **words}
        )
        return lively(Siglip2Model(config))


def dinov2(seed: int = 2, registers: int = 0) -> Any:
    import transformers

    kind = "Dinov2WithRegisters" if registers else "Dinov2"
    sizes = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4, "image_size": 28, "patch_size": 7}
    extra = {"num_register_tokens": registers} if registers else {}
    with seeded(seed):
        config = getattr(transformers, f"{kind}Config")(**sizes, **extra)
        return lively(getattr(transformers, f"{kind}Model")(config))


def lively(model: Any) -> Any:
    """The model with every weight random, biases and norms too, so that none of them can be left out unnoticed."""
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if name.endswith("logit_scale"):
                continue
            around = 1.0 if "norm" in name and name.endswith("weight") else 0.0
            spread = weight.shape[-1] ** -0.5 if weight.ndim > 1 else 0.1
            weight.copy_(around + spread * torch.randn_like(weight))
    return model.eval()


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield


def clip_package(folder: Path, precision: str = "fp32", **options: Any) -> Path:
    """A tiny CLIP, written as a model package."""
    checkpoint = build_clip(clip(**options), tokenizer(), CLIP_MEAN, CLIP_STD)
    write_package(checkpoint, folder, folder.name, "random weights", "none", precision)
    return folder


def sam(seed: int = 3) -> Any:
    """A SAM for images of 64 pixels: 8 x 8 patches, the second block's attention is over all of them."""
    from transformers import SamConfig, SamModel

    with seeded(seed):
        model = SamModel(
            SamConfig(
                attn_implementation="eager",
                vision_config={
                    "hidden_size": 24, "output_channels": 16, "num_hidden_layers": 2, "num_attention_heads": 3,
                    "image_size": 64, "patch_size": 8, "window_size": 4, "global_attn_indexes": [1], "mlp_dim": 48,
                    "num_pos_feats": 8,
                },
                prompt_encoder_config={
                    "hidden_size": 16, "image_size": 64, "patch_size": 8, "image_embedding_size": 8,
                    "mask_input_channels": 4,
                },
                mask_decoder_config={
                    "hidden_size": 16, "mlp_dim": 32, "num_hidden_layers": 2, "num_attention_heads": 2,
                    "iou_head_hidden_dim": 16, "iou_head_depth": 2,
                },
            )
        )  # fmt: skip
        model.set_attn_implementation("eager")
        return lively(model)


def sam2(seed: int = 4) -> Any:
    """A SAM 2 for images of 64 pixels: features of 16 x 16, 8 x 8 and 4 x 4."""
    from transformers import Sam2Config, Sam2Model
    from transformers.models.sam2.configuration_sam2 import Sam2HieraDetConfig, Sam2VisionConfig

    backbone = Sam2HieraDetConfig(
        hidden_size=8, num_attention_heads=1, image_size=[64, 64], blocks_per_stage=[1, 1, 3, 1],
        embed_dim_per_stage=[8, 16, 32, 64], num_attention_heads_per_stage=[1, 1, 2, 2],
        window_size_per_stage=[4, 4, 4, 2], global_attention_blocks=[3], mlp_ratio=2.0,
        window_positional_embedding_background_size=[4, 4],
    )  # fmt: skip
    vision = Sam2VisionConfig(
        backbone_config=backbone, backbone_channel_list=[64, 32, 16, 8], fpn_hidden_size=16,
        backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]],
    )  # fmt: skip
    prompts = {"hidden_size": 16, "image_size": 64, "patch_size": 16, "mask_input_channels": 4}
    decoder = {"hidden_size": 16, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16}
    with seeded(seed):
        return lively(
            Sam2Model(Sam2Config(vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=decoder))
        )


def frame(height: int = 60, width: int = 92, seed: int = 0) -> Frame:
    rgb = np.random.default_rng(seed).integers(0, 256, (height // 4 + 1, width // 4 + 1, 3), dtype=np.uint8)
    rgb = np.ascontiguousarray(rgb.repeat(4, axis=0).repeat(4, axis=1)[:height, :width])
    return Frame(0, 0.0, rgb, np.ones(rgb.shape[:2], np.float32), Intrinsics(width, height, width, width, 0, 0))
