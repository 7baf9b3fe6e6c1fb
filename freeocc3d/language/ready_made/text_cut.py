"""Makes the network ``text`` of a package from the text graph of a ready-made export."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx

from .onnx_graphs import Additions, CutError, OnnxGraph, join, run_model

_WHOLE_NUMBERS = {onnx.TensorProto.INT64: np.int64, onnx.TensorProto.INT32: np.int32}
_TOKENS, _MASK = "input_ids", "attention_mask"
_SHORT = 7
"""Tokens of a text that is shorter than the longest."""


def cut_text(
    model: onnx.ModelProto, output: str, dimension: int, longest: int, side: int
) -> tuple[onnx.ModelProto, bool]:
    """The network that turns ``tokens`` (T, L) into ``features`` (T, D), the graph's ``output``; and whether all texts
    must have the ``longest`` L.

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
    fixed = not _gives(made, _SHORT, dimension)
    if fixed and not _gives(made, longest, dimension):
        raise CutError(f"it does not turn two texts of {longest} tokens into {dimension} numbers each")
    return made, fixed


def _one(value: int, kind: int) -> Any:
    return onnx.helper.make_tensor("value", kind, [1], [value])


def _gives(model: onnx.ModelProto, length: int, dimension: int) -> bool:
    try:
        (features,) = run_model(model, ["features"], {"tokens": np.ones((2, length), np.int64)})
    except CutError:
        return False
    return features.shape == (2, dimension)
