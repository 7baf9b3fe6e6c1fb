"""Makes the network ``image`` of a package of kind "dense" from a vision graph that averages a map of cells into an
embedding, as convolutional CLIPs do (MobileCLIP, CLIP's ResNets without attention pooling).

What follows the average (a projection, perhaps a norm) is applied to each cell alone instead: the feature of a cell is
the embedding of an image with that cell alone. Where what follows is linear, as in MobileCLIP, their mean is the
embedding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx

from .onnx_graphs import FLOAT, Additions, CutError, OnnxGraph, join, run_model
from .vision_cut import Tail

_AVERAGES = ("GlobalAveragePool", "ReduceMean")


@dataclass(frozen=True)
class PoolingCut:
    """The network, D, and the edge of a cell in pixels."""

    image: onnx.ModelProto
    dimension: int
    patch: int


def cut_pooling(model: onnx.ModelProto, output: str, side: int) -> PoolingCut:
    """The network that gives ``features`` (B, h, w, D) of the cells, of a graph that turns images of side x side pixels
    into the embedding ``output``, (B, D). Its images have any size, or that of training alone where the graph fixes it.

    Raises CutError if the graph does not end with an average of cells.
    """
    graph = OnnxGraph(model)
    if len(graph.inputs) != 1:
        raise CutError(f"it takes {', '.join(graph.inputs)[:80]} instead of an image alone")
    kind = next(own.type.tensor_type.elem_type for own in model.graph.input if own.name == graph.inputs[0])
    dtype = onnx.helper.tensor_dtype_to_np_dtype(kind)
    images = np.random.default_rng(0).normal(size=(2, 3, side, side)).astype(dtype)
    feeds = {graph.inputs[0]: images}
    cells = _averaged_cells(graph, feeds)
    seen = graph.run([cells, output], feeds)
    (_, width, rows, _), dimension = seen[cells].shape, seen[output].shape[-1]
    given, ends = Additions("given"), Additions("ends")
    last = ends.add("Transpose", cells, perm=[0, 2, 3, 1])
    grid = ends.add("Slice", ends.add("Shape", last), ends.constant([0]), ends.constant([3]))
    part = Additions("features of")
    alone = part.add("Reshape", last, part.constant([-1, width, 1, 1]))
    embedded = Tail.of(graph, feeds, cells, output).add_to(part, alone)
    shape = ends.add("Concat", grid, ends.constant([-1]), axis=0)
    part.cast(part.add("Reshape", embedded, shape), np.dtype(np.float32), "features")
    instead = {graph.inputs[0]: given.cast("image", dtype)}

    def network(*size: Any) -> onnx.ModelProto:
        features = {"features": ["images", "rows", "columns", "size"]}
        return join(graph, {"image": (FLOAT, ["images", 3, *size])}, features, [given, ends, part], instead)

    for made, height in ((network("height", "width"), side + side // rows), (network(side, side), side)):
        try:
            (features,) = run_model(made, ["features"], {"image": np.zeros((3, 3, height, side), np.float32)})
        except CutError:
            continue
        if features.shape == (3, rows * height // side, rows, dimension):
            return PoolingCut(made, dimension, side // rows)
    raise CutError("what follows its average of cells cannot be applied to each of them")


def _averaged_cells(graph: OnnxGraph, feeds: dict[str, Any]) -> str:
    """The tensor (B, C, h, w) that is averaged over h and w, and not used otherwise. Raises CutError."""
    averages = [node for node in graph.nodes if node.op_type in _AVERAGES and graph.sole_user_of_data(node.input[0])]
    seen = graph.run([name for node in averages for name in (node.input[0], node.output[0])], feeds)
    for node in reversed(averages):
        before, after = seen[node.input[0]], seen[node.output[0]]
        if before.ndim == 4 and before.shape[2] == before.shape[3] > 1 and after.size == before[..., 0, 0].size:
            return node.input[0]
    raise CutError("it does not average cells")
