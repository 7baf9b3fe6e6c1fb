"""Makes a model package of a folder with a ready-made ONNX export of CLIP or SigLIP."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import onnx
from msgspec import Meta

from ...core.errors import ModelError
from ...core.regular_files import read_text
from .. import model_packages
from ..model_export.tokenizer_files import clip_tokenizer, siglip_tokenizer
from ..package_files import stated_licence, write_files
from .export_files import Side, Size, load_graph, read_document, save_graph
from .export_layout import LARGEST_TOKENIZER, WORD_GRAPHS, graph_names
from .onnx_graphs import FLOAT, Additions, CutError, OnnxGraph, join, run_model
from .pooling_cut import cut_pooling
from .text_cut import cut_text
from .vision_cut import cut_vision

_OUTPUTS = {"clip": ("image_embeds", "text_embeds"), "siglip": ("pooler_output", "pooler_output")}
_TOKENS = {"clip": 77, "siglip": 64}
_SIDE = 224
_STATISTICS = {
    "clip": ([0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.26130258, 0.27577711]),
    "siglip": ([0.5] * 3, [0.5] * 3),
}
_FIRST_VOCABULARY = 32_000
"""Tokens of SigLIP; SigLIP 2 has more."""
_SCALES = {"clip": 100.0, "siglip": 117.3308, "siglip2": 112.6689}
"""exp(logit_scale) in the weights of the published models of B/16 at 224 pixels; others of a family
differ by some percent. Graphs of single towers do not hold them, and config.json states what training began with.
CLIP's training bounds the scale by 100, which all published models reach."""

_Length = Annotated[int, Meta(ge=8, le=4096)]


class _TextConfig(msgspec.Struct):
    max_position_embeddings: _Length | None = None
    vocab_size: int | None = None
    pad_token_id: int | None = None


class _VisionConfig(msgspec.Struct):
    image_size: Side | None = None


class _Config(msgspec.Struct):
    """What matters of config.json."""

    model_type: str
    text_config: _TextConfig = msgspec.field(default_factory=_TextConfig)
    vision_config: _VisionConfig = msgspec.field(default_factory=_VisionConfig)


class _Preprocessing(msgspec.Struct):
    """What matters of preprocessor_config.json."""

    do_normalize: bool = True
    image_mean: tuple[float, float, float] | None = None
    image_std: tuple[float, float, float] | None = None
    crop_size: Size | Side | None = None
    size: Size | Side | None = None


def package_of_export(
    folder: Path, target: Path, source: str, precision: model_packages.Precision
) -> tuple[model_packages.Package, str]:
    """Writes the package ``target`` of the export in ``folder``; returns it, and what it lacks in a sentence.

    Where the vision graph cannot be cut, the package is of kind "windows". Raises ModelError.
    """
    config = read_document(folder / "config.json", _Config)
    preprocessing = read_document(folder / "preprocessor_config.json", _Preprocessing)
    family = "siglip" if config.model_type.startswith("siglip") else config.model_type.split("_")[0]
    if family not in _OUTPUTS:
        raise ModelError(f"{source} is a model of type '{config.model_type[:40]}': clip and siglip can be used.")
    side = _side(preprocessing.crop_size) or _side(preprocessing.size) or config.vision_config.image_size or _SIDE
    longest = config.text_config.max_position_embeddings or _TOKENS[family]
    graphs = [load_graph(folder, name, source) for name in graph_names(WORD_GRAPHS, precision)]
    for graph, name, output in zip(graphs, graph_names(WORD_GRAPHS, precision), _OUTPUTS[family], strict=True):
        if output not in (found := [own.name for own in graph.graph.output]):
            raise ModelError(
                f"{name} of {source} gives {', '.join(found)[:80]} instead of {output}: it is no {family}."
            )
    lacks = ""
    try:
        cut = cut_vision(graphs[0], _OUTPUTS[family][0], side, precision)
        kind, vision = "clip", {"image": cut.image, "head": cut.head}
        facts = {"dimension": cut.dimension, "patch": cut.patch, "prefix_tokens": cut.prefix_tokens}
    except CutError as error:
        kind, vision, facts, lacks = _without_attention(graphs[0], precision, _OUTPUTS[family][0], side, source, error)
    try:
        text, fixed = cut_text(graphs[1], _OUTPUTS[family][1], facts["dimension"], longest, side)
    except CutError as error:
        raise ModelError(f"{graph_names(WORD_GRAPHS, precision)[1]} of {source} cannot be used: {error}.") from error
    mean, std = _STATISTICS[family]
    if preprocessing.do_normalize:
        mean, std = list(preprocessing.image_mean or mean), list(preprocessing.image_std or std)
    else:
        mean, std = [0.0] * 3, [1.0] * 3
    second = family == "siglip" and (config.text_config.vocab_size or _FIRST_VOCABULARY) > _FIRST_VOCABULARY
    manifest = {
        "name": target.name, "kind": kind, **facts, "input_size": side, "precision": precision,
        "mean": mean, "std": std,
        "logit_scale": _SCALES["siglip2" if second else family], "licence": stated_licence(folder), "source": source,
    }  # fmt: skip
    tokenizer = _tokenizer(folder, family, longest, fixed, second, config.text_config.pad_token_id)
    networks = {part: functools.partial(save_graph, network) for part, network in {**vision, "text": text}.items()}
    return write_files(target, manifest, networks, tokenizer), lacks


def _side(size: Size | int | None) -> int | None:
    return (size.height or size.shortest_edge) if isinstance(size, Size) else size


def _without_attention(
    model: onnx.ModelProto, precision: model_packages.Precision, output: str, side: int, source: str, error: CutError
) -> tuple[str, dict[str, onnx.ModelProto], dict[str, int], str]:
    """Kind, networks and facts of a graph whose last attention cannot be replaced, and what it lacks. Raises
    ModelError."""
    name = graph_names(WORD_GRAPHS, precision)[0]
    try:
        cut = cut_pooling(model, output, side)
    except CutError:
        lacks = (
            f"{name} cannot be cut, because {error}. So it gives one feature to a window of {side} pixels instead of "
            "one to each patch: small things are lost, and edges are coarse."
        )
        return "windows", *_whole_windows(model, output, side, source), lacks
    lacks = (
        f"{name} is convolutional, and such networks often recognize next to nothing in int8: if words find nothing, "
        "pull it with --precision fp16."
    )
    facts = {"dimension": cut.dimension, "patch": cut.patch, "prefix_tokens": 0}
    return "dense", {"image": cut.image}, facts, lacks if precision == "int8" else ""


def _whole_windows(
    model: onnx.ModelProto, output: str, side: int, source: str
) -> tuple[dict[str, onnx.ModelProto], dict[str, int]]:
    """The network ``image`` of a package of kind "windows", and its facts. Raises ModelError."""
    ends = Additions("ends")
    try:
        graph = OnnxGraph(model)
        if len(graph.inputs) != 1:
            raise CutError(f"it takes {', '.join(graph.inputs)[:80]} instead of an image alone")
        kind = next(own.type.tensor_type.elem_type for own in model.graph.input if own.name == graph.inputs[0])
        given = ends.cast("image", onnx.helper.tensor_dtype_to_np_dtype(kind))
        ends.cast(output, np.dtype(np.float32), "pooled")
        inputs = {"image": (FLOAT, ["images", 3, side, side])}
        made = join(graph, inputs, {"pooled": ["images", "size"]}, [ends], {graph.inputs[0]: given})
        (pooled,) = run_model(made, ["pooled"], {"image": np.zeros((2, 3, side, side), np.float32)})
        if pooled.ndim != 2:
            raise CutError(f"it gives {output} of {pooled.ndim} axes")
    except CutError as error:
        raise ModelError(f"The vision graph of {source} cannot be used: {error}.") from error
    patch = next(size for size in (16, 14, side) if side % size == 0)
    return {"image": made}, {"dimension": pooled.shape[1], "patch": patch, "prefix_tokens": 0}


def _tokenizer(folder: Path, family: str, longest: int, fixed: bool, second: bool, pad_id: int | None) -> str:
    """tokenizer.json that cuts and pads texts. Raises ModelError."""
    from tokenizers import Tokenizer

    path = folder / "tokenizer.json"
    try:
        text = read_text(path, LARGEST_TOKENIZER)
        made = Tokenizer.from_str(text)
    except OSError as error:
        raise ModelError(f"Cannot read {path}: {error.strerror}.") from error
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # tokenizers raises bare Exceptions, and panics that are none
        raise ModelError(f"{path} is not a tokenizer.json: {' '.join(str(error).split())[:200]}.") from error
    if family == "clip":
        return clip_tokenizer(text, longest, fixed)
    stated = (made.padding or {}).get("pad_id")
    own = made.token_to_id("<pad>" if second else "</s>")
    pad = next((number for number in (stated, pad_id, own) if number is not None), 1)
    return siglip_tokenizer(text, longest, pad, without_punctuation=not second)
