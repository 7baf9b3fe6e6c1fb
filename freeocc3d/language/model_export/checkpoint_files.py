"""Reads checkpoints from disk or from the Hugging Face hub into networks. Weights come only from safetensors; nothing
is unpickled."""

from __future__ import annotations

import json
from pathlib import Path

from torch import Tensor, nn

from ...core.errors import ModelError
from .. import model_hub
from .checkpoint_networks import (
    CLIP_MEAN,
    CLIP_STD,
    DINO_MEAN,
    DINO_STD,
    Checkpoint,
    build_backbone,
    build_clip,
    build_sam,
    build_siglip,
    build_text_aligned,
)
from .dino_txt import build_dino_txt, is_dino_txt
from .open_clip_weights import clip_from_open_clip
from .perception_encoder import PerceptionFile, build_perception_encoder, find_perception_encoder
from .radio import build_radio
from .tokenizer_files import read_tokenizer

TO_SAFETENSORS = (
    "convert what is published as .pt or .pth with safetensors.torch.save_file(torch.load(FILE, weights_only=True), …)"
)
"""What to do with weights that are published as pickles, which are not read here."""


def read_checkpoint(source: str, tokenizer: Path | None, text: str | None, text_head: Path | None) -> Checkpoint:
    """Reads ``source`` and prepares it for export. Raises ModelError."""
    if source.startswith("open_clip:"):
        model, mean, std = _from_open_clip(source.removeprefix("open_clip:"))
        if tokenizer is None:
            raise ModelError("open_clip has no tokenizer.json: give a folder that contains one with --tokenizer.")
        return build_clip(model, read_tokenizer(tokenizer), mean, std)
    folder = _local(source)
    if (folder / "open_clip_config.json").is_file():
        model, mean, std = _from_open_clip_folder(folder)
        return build_clip(model, read_tokenizer(tokenizer or folder), mean, std)
    if found := find_perception_encoder(folder):
        return _perception_encoder(found, tokenizer or folder)
    if "RADIOModel" in _architectures(folder):
        return _radio(folder, text, tokenizer)
    model = _from_transformers(folder)
    mean, std = _normalization(folder, model.config.model_type)
    kind = model.config.model_type
    if text is not None and text_head is not None:
        other = _local(text)
        return build_text_aligned(model, _clip_of(other), read_tokenizer(tokenizer or other), _safetensors(text_head))
    if text is not None:
        return _with_words(model, _local(text), tokenizer)
    if kind == "clip":
        return build_clip(model, read_tokenizer(tokenizer or folder), mean, std)
    if kind in ("siglip", "siglip2"):
        return build_siglip(model, read_tokenizer(tokenizer or folder), mean, std)
    return build_sam(model, mean, std) if kind == "sam" else build_backbone(model, mean, std)


def _with_words(model: nn.Module, folder: Path, tokenizer: Path | None) -> Checkpoint:
    """A DINO with the weights of dino.txt in ``folder``."""
    state = {name: value for path in sorted(folder.glob("*.safetensors")) for name, value in _safetensors(path).items()}
    if not is_dino_txt(state):
        raise ModelError(
            f"{folder} does not contain dino.txt's vision head and text tower as safetensors files: {TO_SAFETENSORS}. "
            "With the CLIP of a Talk2DINO, give --text-head, too."
        )
    try:
        return build_dino_txt(model, state, read_tokenizer(tokenizer or folder))
    except (KeyError, RuntimeError, ValueError) as error:
        said = " ".join(str(error).split())[:200]
        raise ModelError(f"{folder} does not contain the usual weights of dino.txt for this DINO: {said}.") from error


def _architectures(folder: Path) -> list[str]:
    """What config.json says the network is, in the names of its authors."""
    try:
        stated = json.loads((folder / "config.json").read_text(encoding="utf-8")).get("architectures")
    except (OSError, ValueError, AttributeError):
        return []
    return stated if isinstance(stated, list) else []


def _perception_encoder(found: PerceptionFile, tokenizer: Path) -> Checkpoint:
    words = read_tokenizer(tokenizer) if found.purpose == "Core" else None
    weights = _safetensors(found.path)
    try:
        return build_perception_encoder(found, weights, words)
    except (KeyError, RuntimeError, ValueError, IndexError) as error:
        said = " ".join(str(error).split())[:200]
        raise ModelError(f"{found.path} is not a usual Perception Encoder: {said}.") from error


def _radio(folder: Path, text: str | None, tokenizer: Path | None) -> Checkpoint:
    if text is None:
        raise ModelError(
            f"{folder} is a RADIO, whose words are those of the SigLIP 2 that its adaptor imitates: name that with "
            "--text (google/siglip2-giant-opt-patch16-384 for C-RADIO v3, google/siglip2-so400m-patch16-naflex for v4)."
        )
    other = _local(text)
    words, config = _from_transformers(other), json.loads((folder / "config.json").read_text(encoding="utf-8"))
    if words.config.model_type not in ("siglip", "siglip2"):
        raise ModelError(f"{other} is no SigLIP 2, whose words a RADIO needs.")
    try:
        return build_radio(
            config, _safetensors(folder / "model.safetensors"), words, read_tokenizer(tokenizer or other)
        )
    except (KeyError, RuntimeError, ValueError, TypeError) as error:
        said = " ".join(str(error).split())[:200]
        raise ModelError(f"{folder} is not a usual RADIO: {said}.") from error


def _clip_of(folder: Path) -> nn.Module:
    opened = (folder / "open_clip_config.json").is_file()
    return _from_open_clip_folder(folder)[0] if opened else _from_transformers(folder)


def _local(source: str) -> Path:
    """The folder of a checkpoint; fetches it from the hub if ``source`` is not a folder."""
    if Path(source).is_dir():
        return Path(source)
    return model_hub.pull_package(source)


def _from_transformers(folder: Path) -> nn.Module:
    import transformers

    transformers.logging.set_verbosity_error()
    try:
        config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
        name = {
            "clip": "CLIPModel", "siglip": "SiglipModel", "siglip2": "Siglip2Model", "vit": "ViTModel",
            "dinov2": "Dinov2Model", "dinov2_with_registers": "Dinov2WithRegistersModel",
            "dinov3_vit": "DINOv3ViTModel", "sam": "SamModel",
        }[config["model_type"]]  # fmt: skip
        loaded = getattr(transformers, name).from_pretrained(
            folder, use_safetensors=True, local_files_only=True, attn_implementation="eager"
        )
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise ModelError(
            f"{folder} does not contain a checkpoint of CLIP, SigLIP, DINO, RADIO or SAM as config.json and "
            f"model.safetensors, nor a Perception Encoder as PE-….safetensors: {' '.join(str(error).split())}."
        ) from error
    return loaded.float().eval()


def _from_open_clip_folder(folder: Path) -> tuple[nn.Module, list[float], list[float]]:
    try:
        config = json.loads((folder / "open_clip_config.json").read_text(encoding="utf-8"))
        state = _safetensors(folder / "open_clip_model.safetensors")
        model = clip_from_open_clip(state, config["model_cfg"])
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        said = " ".join(str(error).split())[:200]
        raise ModelError(f"{folder} is not a usual OpenCLIP ViT: {said}.") from error
    own = config.get("preprocess_cfg", {})
    return model, list(own.get("mean", CLIP_MEAN)), list(own.get("std", CLIP_STD))


def _from_open_clip(name: str) -> tuple[nn.Module, list[float], list[float]]:
    import open_clip

    architecture, _, weights = name.partition("/")
    made = open_clip.create_model(architecture, pretrained=weights)
    state = {key: value.float() for key, value in made.state_dict().items()}
    config = {
        **open_clip.get_model_config(architecture),
        "quick_gelu": "quickgelu" in architecture or weights == "openai",
    }
    return clip_from_open_clip(state, config), CLIP_MEAN, CLIP_STD


def _safetensors(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return {name: value.float() for name, value in load_file(path).items()}
    except (OSError, SafetensorError) as error:
        raise ModelError(f"Cannot read the weights {path}: {error}.") from error


def _normalization(folder: Path, kind: str) -> tuple[list[float], list[float]]:
    """Mean and standard deviation from a checkpoint's preprocessor_config.json, or the usual ones for its kind."""
    path = folder / "preprocessor_config.json"
    stated = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    usual = {"clip": (CLIP_MEAN, CLIP_STD), "siglip": ([0.5] * 3, [0.5] * 3), "siglip2": ([0.5] * 3, [0.5] * 3)}.get(
        kind, (DINO_MEAN, DINO_STD)
    )
    return list(stated.get("image_mean", usual[0])), list(stated.get("image_std", usual[1]))
