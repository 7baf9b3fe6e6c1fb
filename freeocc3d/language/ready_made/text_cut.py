"""Makes the network ``text`` of a package from the text graph of a ready-made export."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from .onnx_graphs import Additions, CutError, OnnxGraph, join, run_model
from .vision_cut import TOLERANCE

_WHOLE_NUMBERS = {onnx.TensorProto.INT64: np.int64, onnx.TensorProto.INT32: np.int32}
_TOKENS, _MASK = "input_ids", "attention_mask"
_SHORT = 7
"""Tokens of a text that is shorter than the longest."""


def cut_text(
    model: onnx.ModelProto, output: str, dimension: int, longest: int, side: int
) -> tuple[onnx.ModelProto, bool]:
    """The network that turns ``tokens`` (T, L) into ``features`` (T, D), the graph's ``output``; and whether all texts
    must have the ``longest`` L: a graph may be made for it alone, or attend to what follows a text, as MobileCLIP does.

    Other inputs of the graph are left out where the output does not need them. Otherwise the mask is all ones, as in
    both models' training, and the image (1, 3, side, side) is empty. Raises CutError.
    """
    graph = OnnxGraph(model)
    kinds = {own.name: own.type.tensor_type.elem_type for own in model.graph.input}
    if kinds.get(_TOKENS) not in _WHOLE_NUMBERS:
        raise CutError(f"it takes {', '.join(graph.inputs)[:80]} instead of {_TOKENS}")
    given, end = Additions("given"), Additions("end")
    instead = {_TOKENS: given.cast("tokens", np.dtype(_WHOLE_NUMBERS[kinds[_TOKENS]]))}
    for name in sorted(graph.ancestors([output]).intersection(graph.inputs) - {_TOKENS}):
        if name == _MASK:
            instead[name] = given.add("ConstantOfShape", given.add("Shape", "tokens"), value=_one(1, kinds[name]))
        elif kinds[name] not in _WHOLE_NUMBERS:
            instead[name] = given.add("ConstantOfShape", given.constant([1, 3, side, side]), value=_one(0, kinds[name]))
        else:
            raise CutError(f"it needs '{name[:80]}' beside {_TOKENS}")
    end.cast(output, np.dtype(np.float32), "features")
    tokens = {"tokens": (onnx.TensorProto.INT64, ["texts", "tokens"])}
    made = join(graph, tokens, {"features": ["texts", "size"]}, [given, end], instead)
    texts = np.ones((2, _SHORT), np.int64)
    short, whole = (_features(made, own) for own in (texts, np.pad(texts, ((0, 0), (0, longest - _SHORT)))))
    fits = [own is not None and own.shape == (2, dimension) for own in (short, whole)]
    if not any(fits):
        raise CutError(f"it does not turn two texts of {longest} tokens into {dimension} numbers each")
    if short is None or whole is None or not all(fits):
        return made, fits[1]
    units = [own / np.linalg.norm(own, axis=1, keepdims=True) for own in (short, whole)]
    return made, bool(np.linalg.norm(units[0] - units[1], axis=1).max() > TOLERANCE["int8"])


def _one(value: int, kind: int) -> Any:
    return onnx.helper.make_tensor("value", kind, [1], [value])


def _features(model: onnx.ModelProto, tokens: NDArray[np.int64]) -> NDArray[np.float32] | None:
    """The features of texts; None if the network fails on them."""
    try:
        return run_model(model, ["features"], {"tokens": tokens})[0]
    except CutError:
        return None
