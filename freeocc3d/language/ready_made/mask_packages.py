"""Makes a model package of a folder with a ready-made ONNX export of SAM or SAM 2, by the inputs of its graphs.

    vision_encoder               pixel_values (1, 3, S, S) -> image_embeddings, image_positional_embeddings (SAM)
                                                              image_embeddings.0, .1, .2 (SAM 2)
    prompt_encoder_mask_decoder  these, input_points (1, P, 1, 2), input_labels (1, P, 1), and of SAM 2
                                 input_boxes (1, 0, 4)
                                 -> iou_scores (1, P, 3), pred_masks (1, P, 3, S / 4, S / 4)

In the package, all that the first gives to the second is one row of numbers, and points are all prompts. Source of the
layout: ``SamModel`` and ``Sam2Model`` of transformers.js, and ``SamOnnxConfig`` of optimum.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx

from ...core.errors import ModelError
from .. import model_packages
from ..package_files import stated_licence, write_files
from .export_files import Side, load_graph, read_document, save_graph
from .export_layout import MASK_GRAPHS, graph_names
from .onnx_graphs import FLOAT, Additions, CutError, OnnxGraph, join, run_model

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_POINTS, _LABELS, _BOXES = "input_points", "input_labels", "input_boxes"
_SCORES, _MASKS = "iou_scores", "pred_masks"
_FOUND = 3
"""Masks for each point: whole, part and part of a part."""
_FRACTION = 4
"""Pixels of a mask in a patch of SAM, along an axis."""


class _Size(msgspec.Struct):
    longest_edge: Side | None = None
    height: Side | None = None
    width: Side | None = None


class _Preprocessing(msgspec.Struct):
    """What matters of preprocessor_config.json."""

    size: _Size
    image_mean: tuple[float, float, float] = _MEAN
    image_std: tuple[float, float, float] = _STD


def package_of_mask_export(
    folder: Path, target: Path, source: str, precision: model_packages.Precision
) -> model_packages.Package:
    """Writes the package ``target``, of kind "prompts", of the export in ``folder``. Raises ModelError."""
    preprocessing = read_document(folder / "preprocessor_config.json", _Preprocessing)
    size = preprocessing.size
    side = size.longest_edge or size.height
    if side is None or (size.longest_edge is None and size.width != side):
        raise ModelError(f"preprocessor_config.json of {source} does not state the side of a square image.")
    names = graph_names(MASK_GRAPHS, precision)
    encoder, decoder = (load_graph(folder, name, source) for name in names)
    try:
        shapes = _find_shared(OnnxGraph(encoder), OnnxGraph(decoder), side)
        image = _join_encoder(OnnxGraph(encoder), shapes, side)
        masks = _join_decoder(OnnxGraph(decoder), shapes)
        width = _check_masks(masks, sum(int(np.prod(shape)) for shape in shapes.values()), side)
    except CutError as error:
        raise ModelError(f"{names[0]} and {names[1]} of {source} cannot be used: {error}.") from error
    manifest = {
        "name": target.name, "kind": "prompts", "dimension": list(shapes.values())[-1][1],
        "patch": max(1, _FRACTION * side // width), "input_size": side, "precision": precision,
        "mean": list(preprocessing.image_mean), "std": list(preprocessing.image_std),
        "stretched": size.longest_edge is None, "licence": stated_licence(folder), "source": source,
    }  # fmt: skip
    networks = {
        part: functools.partial(save_graph, network) for part, network in {"image": image, "masks": masks}.items()
    }
    return write_files(target, manifest, networks, None)


def _find_shared(encoder: OnnxGraph, decoder: OnnxGraph, side: int) -> dict[str, tuple[int, ...]]:
    """Name -> shape, for one image, of what the encoder gives to the decoder. Raises CutError."""
    shared = [name for name in encoder.outputs if name in decoder.inputs]
    rest = set(decoder.inputs) - set(shared)
    if len(encoder.inputs) != 1 or not shared or _POINTS not in rest or rest - {_POINTS, _LABELS, _BOXES}:
        raise CutError(
            f"they take {', '.join(encoder.inputs)[:80]} and {', '.join(decoder.inputs)[:160]}, which are not an "
            "image, and what it gives with points"
        )
    if lacking := [name for name in (_SCORES, _MASKS) if name not in decoder.outputs]:
        raise CutError(f"the second gives {', '.join(decoder.outputs)[:80]}, without {' and '.join(lacking)}")
    given = {encoder.inputs[0]: np.zeros((1, 3, side, side), _type_of(encoder, encoder.inputs[0]))}
    found = dict(zip(shared, run_model(encoder.model, shared, given), strict=True))
    if any(array.ndim < 2 or array.shape[0] != 1 or not array.size for array in found.values()):
        raise CutError("the first gives something else than features of one image")
    return {name: array.shape for name, array in found.items()}


def _join_encoder(graph: OnnxGraph, shapes: dict[str, tuple[int, ...]], side: int) -> onnx.ModelProto:
    """From ``image`` to ``features``."""
    ends = Additions("ends")
    given = ends.cast("image", _type_of(graph, graph.inputs[0]))
    flat = [ends.add("Flatten", ends.cast(name, np.dtype(np.float32)), axis=1) for name in shapes]
    ends.add("Concat", *flat, output="features", axis=1)
    inputs, outputs = {"image": (FLOAT, [1, 3, side, side])}, {"features": [1, "numbers"]}
    return join(graph, inputs, outputs, [ends], {graph.inputs[0]: given})


def _join_decoder(graph: OnnxGraph, shapes: dict[str, tuple[int, ...]]) -> onnx.ModelProto:
    """From ``features`` and ``points`` to ``masks`` and ``scores``."""
    ends, start = Additions("ends"), 0
    instead = {}
    for name, shape in shapes.items():
        end = start + int(np.prod(shape))
        part = ends.add("Slice", "features", *(ends.constant([value]) for value in (start, end, 1)))
        instead[name] = ends.cast(ends.add("Reshape", part, ends.constant(shape)), _type_of(graph, name))
        start = end
    prompts = ends.add("Reshape", "points", ends.constant([1, -1, 1, 2]))
    instead[_POINTS] = ends.cast(prompts, _type_of(graph, _POINTS))
    if _LABELS in graph.inputs:
        across = ends.add("Slice", "points", *(ends.constant([value]) for value in (0, 1, 2)))
        ones = ends.add("Cast", ends.add("Equal", across, across), to=onnx.TensorProto.INT64)
        instead[_LABELS] = ends.cast(ones, _type_of(graph, _LABELS))
    if _BOXES in graph.inputs:
        instead[_BOXES] = ends.constant(np.zeros((1, 0, 4)), _type_of(graph, _BOXES))
    for name, output in ((_MASKS, "masks"), (_SCORES, "scores")):
        ends.cast(name, np.dtype(np.float32), output)
    inputs: dict[str, tuple[int, list[Any]]] = {"features": (FLOAT, [1, start]), "points": (FLOAT, [1, "points", 2])}
    outputs = {"masks": [1, "points", _FOUND, "rows", "columns"], "scores": [1, "points", _FOUND]}
    return join(graph, inputs, outputs, [ends], instead)


def _check_masks(model: onnx.ModelProto, numbers: int, side: int) -> int:
    """Edge of the masks of two points, in their pixels. Raises CutError if they are not square masks of the image."""
    points = np.array([[[0.25, 0.25], [0.5, 0.75]]], np.float32) * side
    fed = {"features": np.zeros((1, numbers), np.float32), "points": points}
    masks, scores = run_model(model, ["masks", "scores"], fed)
    wanted = (1, 2, _FOUND, *masks.shape[-1:] * 2), (1, 2, _FOUND)
    if (masks.shape, scores.shape) != wanted or not 1 <= masks.shape[-1] <= side:
        raise CutError(f"two points give masks of {masks.shape} and scores of {scores.shape}")
    return int(masks.shape[-1])


def _type_of(graph: OnnxGraph, name: str) -> np.dtype[Any]:
    """The type of the numbers of an input."""
    kind = next(own.type.tensor_type.elem_type for own in graph.model.graph.input if own.name == name)
    return np.dtype(onnx.helper.tensor_dtype_to_np_dtype(kind))
