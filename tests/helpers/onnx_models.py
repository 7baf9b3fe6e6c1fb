"""Small networks for tests: a 1 x 1 convolution of the image, in every form of segmentation networks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

COLORS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], np.float32)
"""RGB in 0…1 that each class of ``write_classifier`` is made for; the first is void."""

SHARPNESS = 4.0


def logits(image: NDArray[np.floating]) -> NDArray[np.float32]:
    """(…, 4) of (…, 3) normalized colors: minus half the squared distance to a class's color, but for a constant."""
    return (SHARPNESS * (image @ COLORS.T - 0.5 * (COLORS**2).sum(axis=1))).astype(np.float32)


def write_classifier(
    path: Path,
    size: tuple[Any, Any] = ("height", "width"),
    dtype: int = TensorProto.FLOAT,
    tail: str = "logits",
    image_last: bool = False,
    classes_last: bool = False,
    shrink: int = 1,
) -> Path:
    """``logits`` of every pixel as a network. size: height and width of its input, names where any will do.

    tail: "logits", "softmax" or "argmax".  shrink: the output is smaller by this factor.
    """
    weight = numpy_helper.from_array((SHARPNESS * COLORS)[:, :, None, None], "weight")
    bias = numpy_helper.from_array(-0.5 * SHARPNESS * (COLORS**2).sum(axis=1), "bias")
    nodes, at = [], "image"

    def add(kind: str, *more: str, **attributes: Any) -> None:
        nonlocal at
        nodes.append(helper.make_node(kind, [at, *more], [f"after{len(nodes)}"], **attributes))
        at = f"after{len(nodes) - 1}"

    initializers = [weight, bias]
    if dtype != TensorProto.FLOAT:
        add("Cast", to=TensorProto.FLOAT)
    if dtype == TensorProto.UINT8:
        initializers.append(numpy_helper.from_array(np.float32(255), "range"))
        add("Div", "range")
    if image_last:
        add("Transpose", perm=[0, 3, 1, 2])
    if shrink > 1:
        add("AveragePool", kernel_shape=[shrink] * 2, strides=[shrink] * 2)
    add("Conv", "weight", "bias")
    if tail == "softmax":
        add("Softmax", axis=1)
    if tail == "argmax":
        add("ArgMax", axis=1, keepdims=0)
    elif classes_last:
        add("Transpose", perm=[0, 2, 3, 1])
    inner = [edge // shrink if isinstance(edge, int) else f"{edge}_out" for edge in size]
    out_shape = [1, *inner] if tail == "argmax" else ([1, *inner, 4] if classes_last else [1, 4, *inner])
    out_type = TensorProto.INT64 if tail == "argmax" else TensorProto.FLOAT
    in_shape = [1, *size, 3] if image_last else [1, 3, *size]
    return write_model(
        path,
        nodes,
        [helper.make_tensor_value_info("image", dtype, in_shape)],
        [helper.make_tensor_value_info(at, out_type, out_shape)],
        initializers,
    )


def write_model(
    path: Path, nodes: list[Any], inputs: list[Any], outputs: list[Any], initializers: list[Any] | None = None
) -> Path:
    """A graph as a file that ONNX Runtime takes."""
    graph = helper.make_graph(nodes, "test", inputs, outputs, initializers or [])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def write_identity(path: Path, shape: list[Any], dtype: int = TensorProto.FLOAT, inputs: int = 1) -> Path:
    """A network that gives back its first input, of a shape."""
    named = [helper.make_tensor_value_info(f"image{n}" if n else "image", dtype, shape) for n in range(inputs)]
    node = helper.make_node("Identity", ["image"], ["out"])
    return write_model(path, [node], named, [helper.make_tensor_value_info("out", dtype, shape)])
