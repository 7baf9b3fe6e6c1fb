#!/usr/bin/env python3
"""Turn a checkpoint into a model package: networks as ONNX, tokenizer.json and a manifest, for the encoders of layer 3.

    python tools/export_encoder.py FOLDER -o NAME                       CLIP, SigLIP, DINO, DINOv2, SAM of transformers
    python tools/export_encoder.py FOLDER -o NAME --precision int8      smaller and faster, see tools/benchmark.py
    python tools/export_encoder.py open_clip:ViT-B-16/laion2b_s34b_b88k -o NAME --tokenizer FOLDER
    python tools/export_encoder.py DINOV2 -o NAME --text CLIP --text-head talk2dino.safetensors

FOLDER holds config.json with model.safetensors, or open_clip_config.json with open_clip_model.safetensors, and for text
tokenizer.json, or vocab.json with merges.txt; a name of the Hugging Face hub works where it can be reached. Weights are
read from safetensors alone: nothing is unpickled. Needs pip install 'freeocc3d[export]'.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import re
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import encoder_graphs as graphs
import torch
import yaml
from encoder_tokenizers import clip_tokenizer, end_token, read_tokenizer, siglip_tokenizer
from torch import Tensor, nn

from freeocc3d.core.errors import FreeOccError, ModelError
from freeocc3d.language import model_packages

PRECISIONS = ("fp32", "fp16", "int8")
_OPSET = 18
_CLIP_MEAN, _CLIP_STD = [0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.26130258, 0.27577711]
_DINO_MEAN, _DINO_STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]


@dataclass(frozen=True)
class Network:
    """A module to export: example inputs by name, which of their axes may have any length, and its outputs' names."""

    module: nn.Module
    inputs: dict[str, Tensor]
    dynamic: dict[str, tuple[int, ...]]
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class Checkpoint:
    """What is exported: networks by part, the tokenizer as JSON, and the manifest's facts."""

    kind: str
    networks: dict[str, Network]
    facts: dict[str, Any]
    tokenizer: str | None = None


def export(checkpoint: Checkpoint, folder: Path, name: str, source: str, licence: str, precision: str = "fp32") -> None:
    """Write a package; it is whole or it is not there. Raises ModelError."""
    if folder.exists():
        raise ModelError(f"{folder} exists: choose another folder for the package.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
        made = Path(temporary) / "package"
        made.mkdir()
        parts = {}
        for part, network in checkpoint.networks.items():
            parts[part] = f"{part}.onnx"
            write_onnx(network, made / parts[part])
            convert(made / parts[part], precision)
        if checkpoint.tokenizer is not None:
            parts["tokenizer"] = "tokenizer.json"
            (made / parts["tokenizer"]).write_text(checkpoint.tokenizer, encoding="utf-8")
        manifest = {
            "format": model_packages.FORMAT,
            "name": name,
            "kind": checkpoint.kind,
            **checkpoint.facts,
            "precision": precision,
            "licence": licence,
            "source": source,
            "parts": parts,
            "files": {file: model_packages.sha256(made / file) for file in parts.values()},
        }
        (made / model_packages.MANIFESTS[0]).write_text(yaml.safe_dump(manifest, sort_keys=False), encoding="utf-8")
        package = model_packages.read(made)
        for part in checkpoint.networks:
            package.session(part)  # what is written can be run
        os.replace(made, folder)


def write_onnx(network: Network, path: Path) -> None:
    """Export one network."""
    any_length = {
        name: dict.fromkeys(network.dynamic.get(name, ()), torch.export.Dim.DYNAMIC) for name in network.inputs
    }
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.module.eval(), tuple(network.inputs.values()), str(path), input_names=list(network.inputs),
            output_names=list(network.outputs), dynamic_shapes=any_length, dynamo=True, external_data=False,
            opset_version=_OPSET, verbose=False,
        )  # fmt: skip


def convert(path: Path, precision: str) -> None:
    """Bring a written network to another precision: fp16 halves weights and sums; int8 quantises the weights of matrix
    products, one scale a column, and its inputs as they come. Inputs and outputs stay float32."""
    if precision == "fp16":
        import onnx
        from onnxruntime.transformers.float16 import convert_float_to_float16

        onnx.save(convert_float_to_float16(onnx.load(path), keep_io_types=True), path)
    elif precision == "int8":
        from onnxruntime.quantization import QuantType, quantize_dynamic

        whole = path.with_suffix(".fp32.onnx")
        path.rename(whole)
        quantize_dynamic(
            whole, path, op_types_to_quantize=["MatMul", "Gemm"], per_channel=True, weight_type=QuantType.QInt8,
            extra_options={"MatMulConstBOnly": True},
        )  # fmt: skip
        whole.unlink()


def clip(model: nn.Module, tokenizer: str, mean: list[float], std: list[float]) -> Checkpoint:
    """Of transformers' CLIPModel, as its tokenizer.json is cut and padded by ``clip_tokenizer``."""
    text, vision = model.config.text_config, model.config.vision_config
    network = graphs.ClipText(model, end_token(text.eos_token_id, tokenizer))
    tokens = torch.zeros((2, 7), dtype=torch.int64)
    return Checkpoint(
        "clip",
        {**_image_networks(model, graphs.ClipHead(model)), "text": _text_network(network, tokens, (0, 1))},
        _facts(model.config.projection_dim, mean, std, vision, 1, math.exp(model.logit_scale.item())),
        clip_tokenizer(tokenizer, text.max_position_embeddings),
    )


def siglip(model: nn.Module, tokenizer: str, mean: list[float], std: list[float]) -> Checkpoint:
    """Of transformers' SiglipModel."""
    text, vision = model.config.text_config, model.config.vision_config
    tokens = torch.zeros((2, text.max_position_embeddings), dtype=torch.int64)
    words = _text_network(graphs.SiglipText(model), tokens, (0,))
    return Checkpoint(
        "clip",
        {**_image_networks(model, graphs.SiglipHead(model)), "text": words},
        _facts(vision.hidden_size, mean, std, vision, 0, math.exp(model.logit_scale.item())),
        siglip_tokenizer(tokenizer, text.max_position_embeddings, text.pad_token_id),
    )  # fmt: skip


def backbone(model: nn.Module, mean: list[float], std: list[float]) -> Checkpoint:
    """Of transformers' ViTModel (DINO) or Dinov2Model, with registers or without."""
    network = Network(graphs.DinoPatches(model), {"image": _image(model.config)}, {"image": (0, 2, 3)}, ("features",))
    facts = _facts(model.config.hidden_size, mean, std, model.config, 0, 1.0)
    return Checkpoint("backbone", {"image": network}, facts)


def dense(model: nn.Module, text_model: nn.Module, tokenizer: str, head: dict[str, Tensor]) -> Checkpoint:
    """A DINOv2 whose patches a CLIP's words are brought to by ``head``, as Talk2DINO's are."""
    seen = backbone(model, _DINO_MEAN, _DINO_STD)
    text = text_model.config.text_config
    network = graphs.ClipText(text_model, end_token(text.eos_token_id, tokenizer), graphs.Talk2DinoHead(head))
    tokens = torch.zeros((2, 7), dtype=torch.int64)
    return Checkpoint(
        "dense",
        {**seen.networks, "text": _text_network(network, tokens, (0, 1))},
        {**seen.facts, "logit_scale": 1 / 0.07},  # the temperature that Talk2DINO is trained with
        clip_tokenizer(tokenizer, text.max_position_embeddings),
    )


def sam(model: nn.Module, mean: list[float], std: list[float]) -> Checkpoint:
    """Of transformers' SamModel with "eager" attention, whose weights are given out."""
    vision = model.config.vision_config
    side, grid = vision.image_size, vision.image_size // vision.patch_size
    features = torch.zeros((1, vision.output_channels, grid, grid))
    points = torch.zeros((1, 5, 2))
    return Checkpoint(
        "sam",
        {
            "image": Network(
                graphs.SamImage(model), {"image": torch.zeros((1, 3, side, side))}, {}, ("features", "attention")
            ),
            "masks": Network(
                graphs.SamMasks(model), {"features": features, "points": points}, {"points": (1,)}, ("masks", "scores")
            ),
        },
        _facts(vision.output_channels, mean, std, vision, 0, 1.0),
    )


def _image(config: Any) -> Tensor:
    patch = config.patch_size
    return torch.zeros((2, 3, 3 * patch, 5 * patch))


def _image_networks(model: nn.Module, head: nn.Module) -> dict[str, Network]:
    config = model.config.vision_config
    trunk, image = graphs.ImageTrunk(model.vision_model), _image(config)
    stream = torch.zeros((2, 11, config.hidden_size))
    return {
        "image": Network(trunk, {"image": image}, {"image": (0, 2, 3)}, ("queries", "keys", "values", "stream")),
        "head": Network(
            head, {"mixed": stream, "stream": stream.clone()}, {"mixed": (0, 1), "stream": (0, 1)},
            ("features", "reduced", "pooled"),
        ),
    }  # fmt: skip


def _text_network(module: nn.Module, tokens: Tensor, dynamic: tuple[int, ...]) -> Network:
    return Network(module, {"tokens": tokens}, {"tokens": dynamic}, ("features",))


def _facts(
    dimension: int, mean: list[float], std: list[float], vision: Any, prefix: int, logit_scale: float
) -> dict[str, Any]:
    return {
        "dimension": int(dimension), "mean": mean, "std": std, "patch": int(vision.patch_size),
        "input_size": int(vision.image_size), "prefix_tokens": prefix, "logit_scale": round(logit_scale, 4),
    }  # fmt: skip


# Checkpoints


def read_checkpoint(source: str, tokenizer: Path | None, text: str | None, text_head: Path | None) -> Checkpoint:
    """What SOURCE is, made ready for export. Raises ModelError."""
    if source.startswith("open_clip:"):
        model, mean, std = _from_open_clip(source.removeprefix("open_clip:"))
        if tokenizer is None:
            raise ModelError("open_clip brings no tokenizer.json: name a folder that holds one with --tokenizer.")
        return clip(model, read_tokenizer(tokenizer), mean, std)
    folder = _local(source)
    if (folder / "open_clip_config.json").is_file():
        model, mean, std = _from_open_clip_folder(folder)
        return clip(model, read_tokenizer(tokenizer or folder), mean, std)
    model = _from_transformers(folder)
    mean, std = _normalisation(folder, model.config.model_type)
    kind = model.config.model_type
    if text is not None and text_head is not None:
        other = _local(text)
        return dense(model, _clip_of(other), read_tokenizer(tokenizer or other), _safetensors(text_head))
    if kind == "clip":
        return clip(model, read_tokenizer(tokenizer or folder), mean, std)
    if kind == "siglip":
        return siglip(model, read_tokenizer(tokenizer or folder), mean, std)
    return sam(model, mean, std) if kind == "sam" else backbone(model, mean, std)


def _clip_of(folder: Path) -> nn.Module:
    opened = (folder / "open_clip_config.json").is_file()
    return _from_open_clip_folder(folder)[0] if opened else _from_transformers(folder)


def _local(source: str) -> Path:
    """The folder of a checkpoint, fetched from the hub where it is no folder here."""
    if Path(source).is_dir():
        return Path(source)
    from freeocc3d.language import model_hub

    return model_hub.pull(source)


def _from_transformers(folder: Path) -> nn.Module:
    import transformers

    transformers.logging.set_verbosity_error()
    try:
        config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
        name = {
            "clip": "CLIPModel", "siglip": "SiglipModel", "vit": "ViTModel", "dinov2": "Dinov2Model",
            "dinov2_with_registers": "Dinov2WithRegistersModel", "sam": "SamModel",
        }[config["model_type"]]  # fmt: skip
        loaded = getattr(transformers, name).from_pretrained(
            folder, use_safetensors=True, local_files_only=True, attn_implementation="eager"
        )
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise ModelError(
            f"{folder} is no checkpoint of CLIP, SigLIP, DINO, DINOv2 or SAM as config.json and model.safetensors: "
            f"{' '.join(str(error).split())}."
        ) from error
    return loaded.float().eval()


def _from_open_clip_folder(folder: Path) -> tuple[nn.Module, list[float], list[float]]:
    try:
        config = json.loads((folder / "open_clip_config.json").read_text(encoding="utf-8"))
        state = _safetensors(folder / "open_clip_model.safetensors")
        model = graphs.clip_of_open_clip(state, config["model_cfg"])
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        said = " ".join(str(error).split())[:200]
        raise ModelError(f"{folder} is no OpenCLIP ViT in its usual form: {said}.") from error
    own = config.get("preprocess_cfg", {})
    return model, list(own.get("mean", _CLIP_MEAN)), list(own.get("std", _CLIP_STD))


def _from_open_clip(name: str) -> tuple[nn.Module, list[float], list[float]]:
    import open_clip

    architecture, _, weights = name.partition("/")
    made = open_clip.create_model(architecture, pretrained=weights)
    state = {key: value.float() for key, value in made.state_dict().items()}
    config = {
        **open_clip.get_model_config(architecture),
        "quick_gelu": "quickgelu" in architecture or weights == "openai",
    }
    return graphs.clip_of_open_clip(state, config), _CLIP_MEAN, _CLIP_STD


def _safetensors(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return {name: value.float() for name, value in load_file(path).items()}
    except (OSError, SafetensorError) as error:
        raise ModelError(f"Cannot read the weights {path}: {error}.") from error


def _normalisation(folder: Path, kind: str) -> tuple[list[float], list[float]]:
    """Mean and standard deviation that a checkpoint's preprocessor_config.json states, or that its kind usually has."""
    path = folder / "preprocessor_config.json"
    stated = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    usual = {"clip": (_CLIP_MEAN, _CLIP_STD), "siglip": ([0.5] * 3, [0.5] * 3)}.get(kind, (_DINO_MEAN, _DINO_STD))
    return list(stated.get("image_mean", usual[0])), list(stated.get("image_std", usual[1]))


def _licence(source: str) -> str:
    """The licence that a model card states, if there is one."""
    card = Path(source) / "README.md"
    found = re.search(r"^license:\s*(\S+)", card.read_text(encoding="utf-8"), re.M) if card.is_file() else None
    return found[1] if found else "not stated: see the source"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", metavar="SOURCE", help="folder of a checkpoint, or a name on the Hugging Face hub")
    parser.add_argument(
        "-o", "--output", required=True, metavar="NAME", help="folder to write, or a plain name: in the models folder"
    )
    parser.add_argument("--precision", choices=PRECISIONS, default="fp32")
    parser.add_argument("--tokenizer", type=Path, metavar="FOLDER", help="where the tokenizer is, if not in SOURCE")
    parser.add_argument("--text", metavar="CLIP", help="checkpoint of the CLIP whose words a DINOv2 is asked with")
    parser.add_argument("--text-head", type=Path, metavar="FILE", help="safetensors of Talk2DINO's projection")
    parser.add_argument("--licence", metavar="NAME", help="of the weights; by default what the model card states")
    given = parser.parse_args()
    if (given.text is None) != (given.text_head is None):
        parser.error("--text and --text-head belong together")
    logging.getLogger().setLevel(logging.ERROR)  # the exporter counts the operators that it skips
    plain = Path(given.output).name == given.output
    folder = model_packages.models_folder() / given.output if plain else Path(given.output)
    try:
        checkpoint = read_checkpoint(given.source, given.tokenizer, given.text, given.text_head)
        export(checkpoint, folder, folder.name, given.source, given.licence or _licence(given.source), given.precision)
        package = model_packages.read(folder)
    except FreeOccError as error:
        raise SystemExit(f"export_encoder: {' '.join(str(error).split())}") from None
    print(f"{folder}: {package.kind}, {package.dimension} dimensions, {package.precision}, {package.bytes:,} bytes")


if __name__ == "__main__":
    main()
