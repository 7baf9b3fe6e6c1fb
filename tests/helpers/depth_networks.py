"""A depth network that returns the image's red."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def write_network(path: Path, size=("height", "width"), channels: int = 3, output: str | None = None) -> Path:
    """The image's red, unnormalized, as its (inverse) depth: (1, 1, H, W)."""
    weight = np.zeros((1, channels, 1, 1), np.float32)
    weight[0, 0] = 0.229
    node = helper.make_node("Conv", ["image", "weight", "bias"], ["depth"])
    graph = helper.make_graph(
        [node], "depth",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, channels, *size])],
        [helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1, 1, *size])],
        [numpy_helper.from_array(weight, "weight"), numpy_helper.from_array(np.array([0.485], np.float32), "bias")],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    if output is not None:
        helper.set_model_props(model, {"output": output})
    onnx.save(model, str(path))
    return path
