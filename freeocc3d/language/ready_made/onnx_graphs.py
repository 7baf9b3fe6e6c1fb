"""ONNX graphs as who makes and who uses each tensor, with what is needed to cut them and to join new parts to them."""

from __future__ import annotations

import collections
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from ...core.errors import ModelError

FLOAT = onnx.TensorProto.FLOAT
_SHAPES = ("Shape", "Size")


class CutError(ModelError):
    """A graph is not built like those that can be cut."""


class OnnxGraph:
    """The tensors of a model by name.

    makers: tensor -> the node that gives it.  users: tensor -> the nodes that take it.  initializers: tensor -> its
    value in the file.  data: tensors that depend on what is in the inputs; those that depend on their shapes alone, and
    constants, do not.
    """

    def __init__(self, model: onnx.ModelProto):
        self.model = model
        self.initializers = {own.name: own for own in model.graph.initializer}
        self.inputs = [own.name for own in model.graph.input if own.name not in self.initializers]
        self.outputs = [own.name for own in model.graph.output]
        self.nodes = _sort_needed(list(model.graph.node), {*self.initializers, *self.inputs}, self.outputs)
        self.makers = {name: node for node in self.nodes for name in node.output if name}
        self.users: dict[str, list[onnx.NodeProto]] = {}
        for node in self.nodes:
            for name in dict.fromkeys(taken_by(node)):
                self.users.setdefault(name, []).append(node)
        self.data = self.descendants(self.inputs, past_shapes=False)

    def descendants(self, names: Iterable[str], past_shapes: bool = True) -> set[str]:
        """These tensors and all that are computed from them; without past_shapes not from their shapes alone."""
        found = set(names)
        for node in self.nodes:
            if (past_shapes or node.op_type not in _SHAPES) and not found.isdisjoint(taken_by(node)):
                found.update(node.output)
        found.discard("")
        return found

    def ancestors(self, names: Iterable[str]) -> set[str]:
        """These tensors and all from which they are computed."""
        found = set(names)
        for node in reversed(self.nodes):
            if not found.isdisjoint(node.output):
                found.update(taken_by(node))
        found.discard("")
        return found

    def data_inputs(self, node: onnx.NodeProto) -> list[str]:
        return [name for name in node.input if name in self.data]

    def sole_user(self, name: str) -> onnx.NodeProto | None:
        """The node that alone takes a tensor, if there is one."""
        users = self.users.get(name, [])
        return users[0] if len(users) == 1 and name not in self.outputs else None

    def sole_user_of_data(self, name: str) -> onnx.NodeProto | None:
        """The node that alone takes a tensor for more than its shape, if there is one."""
        users = [node for node in self.users.get(name, []) if node.op_type not in _SHAPES]
        return users[0] if len(users) == 1 and name not in self.outputs else None

    def is_single(self, name: str) -> bool:
        """Whether a tensor that does not depend on data is one number: a constant of size one, or made of shapes."""
        value = self.constant(name)
        return name not in self.data and (value is None or value.size == 1)

    def constant(self, name: str) -> NDArray[Any] | None:
        """The value of a tensor that stands in the file; None if it is computed."""
        if name in self.initializers:
            return np.asarray(numpy_helper.to_array(self.initializers[name]))
        node = self.makers.get(name)
        if node is not None and node.op_type == "Constant" and node.attribute[0].name == "value":
            return np.asarray(numpy_helper.to_array(node.attribute[0].t))
        return None

    def run(self, names: Sequence[str], feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The values of any tensors. Raises CutError if onnxruntime cannot compute them."""
        wanted = [name for name in dict.fromkeys(names) if name not in self.initializers]
        probed = onnx.ModelProto()
        probed.CopyFrom(self.model)
        del probed.graph.output[:]
        probed.graph.output.extend(onnx.ValueInfoProto(name=name) for name in wanted)
        values = dict(zip(wanted, run_model(probed, wanted, feeds), strict=True)) if wanted else {}
        return values | {name: numpy_helper.to_array(own) for name, own in self.initializers.items() if name in names}


def sign_weights(model: onnx.ModelProto) -> None:
    """Makes int8 of the uint8 weights of quantized matrix products, and of their zero points: both less 128, which
    changes no result. onnxruntime multiplies int8 weights two to three times faster on processors with VNNI or AMX; on
    older ones its sums of them overflow, so that weights stay uint8 there."""
    if not _int8_is_exact():
        return
    bytes_of = {own.name: own for own in model.graph.initializer if own.data_type == onnx.TensorProto.UINT8}
    users = collections.Counter(name for node in model.graph.node for name in taken_by(node))
    for node in model.graph.node:
        names = node.input[1:4:2]  # the weights, and their zero points
        if node.op_type == "MatMulInteger" and len(names) == 2 and all(n in bytes_of and users[n] == 1 for n in names):
            for name in names:
                centered = numpy_helper.to_array(bytes_of[name]).astype(np.int16) - 128
                bytes_of[name].CopyFrom(numpy_helper.from_array(centered.astype(np.int8), name))


@functools.cache
def _int8_is_exact() -> bool:
    """Whether this processor multiplies the largest int8 weights without overflow: without VNNI, the sum of two
    products has 16 bits."""
    inputs = [helper.make_tensor_value_info("a", onnx.TensorProto.UINT8, [1, 64])]
    weights = numpy_helper.from_array(np.full((64, 16), 127, np.int8), "weights")
    product = helper.make_node("MatMulInteger", ["a", "weights"], ["sums"])
    outputs = [helper.make_tensor_value_info("sums", onnx.TensorProto.INT32, [1, 16])]
    model = helper.make_model(
        helper.make_graph([product], "product", inputs, outputs, [weights]),
        opset_imports=[helper.make_opsetid("", 13)], ir_version=7,
    )  # fmt: skip
    (sums,) = run_model(model, ["sums"], {"a": np.full((1, 64), 255, np.uint8)})
    return bool((sums == 64 * 255 * 127).all())


def taken_by(node: onnx.NodeProto) -> list[str]:
    """The tensors that a node takes, also inside its branches, without those that are made there."""
    inside: list[str] = []
    for part in (part for own in node.attribute for part in (own.g, *own.graphs)):
        made = {name for n in part.node for name in n.output} | {own.name for own in (*part.input, *part.initializer)}
        inside += (name for n in part.node for name in taken_by(n) if name not in made)
        inside += (own.name for own in part.output if own.name not in made)
    return [*(name for name in node.input if name), *inside]


def run_model(model: onnx.ModelProto, names: Sequence[str], feeds: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
    """Runs a model in memory. Raises CutError."""
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.log_severity_level = 4
    try:
        session = ort.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
        return [np.asarray(array) for array in session.run(list(names), dict(feeds))]
    except Exception as error:  # onnxruntime's exceptions share no base class
        raise CutError(f"onnxruntime cannot run it: {' '.join(str(error).split())[:200]}") from error


class Additions:
    """New nodes and constants, whose tensors have names that no other tensor has."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []

    def _name(self) -> str:
        return f"{self.prefix}/{len(self.nodes) + len(self.initializers)}"

    def add(self, kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        """Adds a node with one output, and returns the name of that."""
        output = output or self._name()
        self.nodes.append(helper.make_node(kind, inputs, [output], name=f"{output} {kind}", **attributes))
        return output

    def constant(self, value: Any, dtype: Any = np.int64) -> str:
        """Adds a constant, and returns its name."""
        name = self._name()
        self.initializers.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def cast(self, name: str, dtype: np.dtype[Any], output: str | None = None) -> str:
        """Adds a conversion to another type of numbers."""
        return self.add("Cast", name, output=output, to=helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))


def join(
    graph: OnnxGraph,
    inputs: Mapping[str, tuple[int, Sequence[Any]]],
    outputs: Mapping[str, Sequence[Any]],
    added: Sequence[Additions],
    instead: Mapping[str, str],
) -> onnx.ModelProto:
    """A model of a graph's nodes and of additions, without those that no output needs.

    inputs: name -> element type and shape.  outputs: name -> shape; all are float32.  instead: tensor of the graph ->
    the tensor that its users take instead. Raises CutError if an output needs another input.
    """
    nodes = []
    for node in graph.nodes:
        copied = onnx.NodeProto()
        copied.CopyFrom(node)
        copied.input[:] = [instead.get(name, name) for name in node.input]
        nodes.append(copied)
    nodes += [node for own in added for node in own.nodes]
    initializers = [*graph.initializers.values(), *(one for own in added for one in own.initializers)]
    kept = _sort_needed(nodes, set(inputs) | {own.name for own in initializers}, list(outputs))
    used = {name for node in kept for name in taken_by(node)}
    made = helper.make_graph(
        kept, "network",
        [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in inputs.items()],
        [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in outputs.items()],
        [own for own in initializers if own.name in used],
    )  # fmt: skip
    model = helper.make_model(made, opset_imports=graph.model.opset_import, producer_name="freeocc3d")
    model.ir_version = max(graph.model.ir_version, 7)
    model.functions.extend(graph.model.functions)
    return model


def _sort_needed(nodes: list[onnx.NodeProto], given: set[str], outputs: list[str]) -> list[onnx.NodeProto]:
    """The nodes that the outputs need, each after those that it needs. Raises CutError if a tensor has no maker."""
    makers = {name: index for index, node in enumerate(nodes) for name in node.output if name}
    order: dict[int, None] = {}
    begun: set[int] = set()
    stack: list[tuple[str, bool]] = [(name, False) for name in reversed(outputs)]
    while stack:
        name, done = stack.pop()
        if name in given:
            continue
        if name not in makers:
            raise CutError(f"it needs '{name[:80]}', which is outside of the part")
        index = makers[name]
        if done:
            order[index] = None
        elif index not in order:
            if index in begun:
                raise CutError(f"the nodes that make '{name[:80]}' form a circle")
            begun.add(index)
            stack.append((name, True))
            stack.extend((taken, False) for taken in taken_by(nodes[index]))
    return [nodes[index] for index in order]
