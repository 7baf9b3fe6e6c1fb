"""Cuts the vision graph of a CLIP or SigLIP into the networks ``image`` and ``head`` of a package (``KINDS``).

What mixes tokens is found by structure: each softmax between two matrix products is an attention, the first addition of
a constant to the tokens that of position embeddings. These parts are written anew, so that images can have any size in
patches; all that works on single tokens (norms, projections, feed-forward layers) stays as it is, quantized or not. The
result is run beside the original and must give the same embedding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from .. import clip_attention
from .onnx_graphs import FLOAT, Additions, CutError, OnnxGraph, join, run_model, taken_by

TOLERANCE = {"fp32": 1e-3, "fp16": 0.02, "int8": 0.1}
"""Largest distance of a unit embedding from the original's. The precisions round sums of about a thousand products at
1e-7, 1e-3 and 1e-2; their order differs where attention is written anew."""

_LAYOUT = ("Reshape", "Transpose", "Cast", "Identity", "Squeeze", "Unsqueeze", "Flatten", "Dropout")
_SCALING = ("Mul", "Div")
_LEAST_OPSET = 13
_FIRST_ADDITIONS = 16
"""Additions of constants, among which that of the position embeddings is looked for."""
_BICUBIC = -0.75
"""PyTorch's coefficient of bicubic interpolation."""


@dataclass(frozen=True)
class VisionCut:
    """The two networks, and what they say about the model: D, edge of a patch in pixels, tokens before the patches."""

    image: onnx.ModelProto
    head: onnx.ModelProto
    dimension: int
    patch: int
    prefix_tokens: int


@dataclass(frozen=True)
class _Attention:
    """The attention of a block: its tensors (B, N, heads d) of projected queries, keys and values, and of the values
    that it mixed, which are of type dtype."""

    projected: tuple[str, str, str]
    mixed: str
    tokens: int
    heads: int
    size: int
    dtype: np.dtype[Any]


@dataclass(frozen=True)
class _Embedding:
    """Where patches become tokens: the tensor (B, C, h, w) of patches, the tokens (B, N, C) that the blocks take, and
    the values of the position embeddings (N, C) and of the tokens before those of patches (prefix, C)."""

    patches: str
    tokens: str
    positions: NDArray[Any]
    first: NDArray[Any]

    @property
    def grid(self) -> int:
        """Rows, and columns, of patches in a training image."""
        return round((len(self.positions) - len(self.first)) ** 0.5)


@dataclass(frozen=True)
class _LastBlock:
    """Tensors (B, N, C) of the last block: the values that its attention mixed, the residual stream before it, the
    output of its attention, and the stream after the block; and the types of the first two."""

    mixed: str
    stream: str
    own: str
    after: str
    dtypes: tuple[np.dtype[Any], np.dtype[Any]]


def cut_vision(model: onnx.ModelProto, output: str, side: int, precision: str) -> VisionCut:
    """The networks of a graph that turns images of side x side pixels into the embedding ``output``, (B, D).

    Raises CutError if the graph is built in another way, or the networks differ from it.
    """
    graph = OnnxGraph(model)
    if max((own.version for own in model.opset_import if own.domain in ("", "ai.onnx")), default=0) < _LEAST_OPSET:
        raise CutError(f"it uses operators older than version {_LEAST_OPSET}")
    if len(graph.inputs) != 1:
        raise CutError(f"it takes {', '.join(graph.inputs)} instead of an image alone")
    images = np.random.default_rng(0).normal(size=(2, 3, side, side)).astype(_type_of(model.graph.input, graph.inputs))
    feeds = {graph.inputs[0]: images}
    blocks = _find_blocks(graph, feeds)
    embedding = _find_embedding(graph, feeds, blocks[0].tokens)
    block = _find_last_block(graph, feeds, blocks[-1].mixed)
    image = _image_network(graph, embedding, blocks, block.stream)
    head = _head_network(graph, block, Tail.of(graph, feeds, block.after, output, blocks[0].tokens))
    expected = graph.run([output], feeds)[output]
    cut = VisionCut(image, head, int(expected.shape[-1]), side // embedding.grid, len(embedding.first))
    _check(cut, images.astype(np.float32), expected, TOLERANCE[precision])
    return cut


def _type_of(infos: Any, names: list[str]) -> Any:
    kind = next(own for own in infos if own.name == names[0]).type.tensor_type.elem_type
    return onnx.helper.tensor_dtype_to_np_dtype(kind)


def _find_blocks(graph: OnnxGraph, feeds: dict[str, NDArray[Any]]) -> list[_Attention]:
    """The attentions in which all tokens attend to all of them, in order. Raises CutError."""
    found = [own for node in graph.nodes if node.op_type == "Softmax" and (own := _tensors_around(graph, node))]
    seen = graph.run([name for own in found for name in own], feeds)
    blocks = []
    for *projected, mixed, weights in found:
        shape = seen[mixed].shape
        if len(shape) != 3 or any(seen[name].shape != shape for name in projected):
            continue
        batch, tokens, width = shape
        if seen[weights].shape[-2:] == (tokens, tokens):
            heads = seen[weights].size // (batch * tokens**2)
            q, k, v = projected
            blocks.append(_Attention((q, k, v), mixed, tokens, heads, width // heads, seen[mixed].dtype))
    if len(blocks) < 2 or len({(own.tokens, own.heads, own.size) for own in blocks}) > 1:
        raise CutError("it has no row of equal blocks with attention")
    return blocks


def _tensors_around(graph: OnnxGraph, softmax: onnx.NodeProto) -> tuple[str, str, str, str, str] | None:
    """Queries, keys, values, mixed values and weights of the attention around a softmax; None if it is no such."""
    weights = softmax.output[0]
    after = _down(graph, weights)
    mixing = graph.sole_user(after)
    before = graph.makers.get(_up(graph, softmax.input[0]))
    if mixing is None or before is None or mixing.op_type != "MatMul" or before.op_type != "MatMul":
        return None
    if mixing.input[0] != after or not {*before.input, *mixing.input} <= graph.data:
        return None
    queries, keys, values = (_up(graph, name) for name in (*before.input, mixing.input[1]))
    return queries, keys, values, _down(graph, mixing.output[0]), weights


def _up(graph: OnnxGraph, name: str) -> str:
    """The tensor from which one is made by other shapes, types and scales alone."""
    while (node := graph.makers.get(name)) is not None:
        data = graph.data_inputs(node)
        scales = node.op_type in _SCALING and all(graph.is_single(n) for n in node.input if n not in data)
        if len(data) != 1 or not (node.op_type in _LAYOUT or scales):
            break
        name = data[0]
    return name


def _down(graph: OnnxGraph, name: str) -> str:
    """The tensor that is made from one by other shapes and types alone, as long as nothing else uses it."""
    while (node := _layout_user(graph, name)) is not None:
        name = node.output[0]
    return name


def _layout_user(graph: OnnxGraph, name: str) -> onnx.NodeProto | None:
    users = [node for node in graph.users.get(name, []) if node.op_type != "Shape"]
    return users[0] if len(users) == 1 and users[0].op_type in _LAYOUT and users[0].input[0] == name else None


def _find_embedding(graph: OnnxGraph, feeds: dict[str, NDArray[Any]], tokens: int) -> _Embedding:
    """Raises CutError."""
    candidates = []
    for node in graph.nodes:
        data = graph.data_inputs(node)
        if node.op_type == "Add" and len(data) == 1:
            other = next(name for name in node.input if name not in data)
            candidates.append((data[0], other, node.output[0]))
    candidates = candidates[:_FIRST_ADDITIONS]
    seen = graph.run([name for names in candidates for name in names], feeds)
    placed = [own for own in candidates if seen[own[2]].ndim == 3 and seen[own[1]].size == seen[own[2]][0].size]
    if not placed or len(seen[placed[0][2]][0]) != tokens:
        raise CutError("it adds no position embeddings to its tokens")
    before, table, after = placed[0]
    width = seen[after].shape[-1]
    positions = seen[table].reshape(tokens, width)
    joined = graph.makers.get(before)
    parts = list(joined.input) if joined is not None and joined.op_type == "Concat" else [before]
    patches = _up(graph, parts[-1])
    seen = graph.run([*parts, patches], feeds)
    if seen[patches].ndim != 4 or seen[patches].shape[1] != width:
        raise CutError("its tokens are not the patches of one convolution")
    rows, columns = seen[patches].shape[2:]
    first = np.concatenate([seen[name][0] for name in parts[:-1]] or [np.zeros((0, width), positions.dtype)])
    if rows != columns or len(first) != tokens - rows * columns:
        raise CutError(f"it makes {tokens} tokens of {rows} x {columns} patches")
    return _Embedding(patches, after, positions, first)


def _find_last_block(graph: OnnxGraph, feeds: dict[str, NDArray[Any]], mixed: str) -> _LastBlock:
    """Raises CutError."""
    inside = graph.descendants([mixed])
    for node in graph.nodes:
        data = graph.data_inputs(node)
        of_block = [name for name in data if name in inside]
        if node.op_type == "Add" and len(data) == 2 and len(of_block) == 1:
            stream = next(name for name in data if name not in inside)
            middle = node.output[0]
            break
    else:
        raise CutError("the last attention has no residual connection")
    for node in graph.users.get(middle, []):
        if node.op_type == "Add" and len(graph.data_inputs(node)) == 2:
            seen = graph.run([mixed, stream], feeds)
            return _LastBlock(mixed, stream, of_block[0], node.output[0], (seen[mixed].dtype, seen[stream].dtype))
    raise CutError("the last block has no feed-forward part")


def _image_network(graph: OnnxGraph, embedding: _Embedding, blocks: list[_Attention], stream: str) -> onnx.ModelProto:
    """The network ``image``."""
    given, ends = Additions("given"), Additions("ends")
    placed, tokens = _embed(embedding)
    kind = _type_of(graph.model.graph.input, graph.inputs)
    instead = {graph.inputs[0]: given.cast("image", kind), embedding.tokens: tokens}
    parts = [given, placed]
    for number, own in enumerate(blocks[:-1]):
        part, instead[own.mixed] = _attend(own, f"attention {number}")
        parts.append(part)
    last = blocks[-1]
    for name, output in zip(last.projected, ("queries", "keys", "values"), strict=True):
        ends.cast(_split(ends, name, last.heads), np.dtype(np.float32), output)
    ends.cast(instead.get(stream, stream), np.dtype(np.float32), "stream")
    outputs: dict[str, list[int | str]] = {
        name: ["images", last.heads, "tokens", last.size] for name in ("queries", "keys", "values")
    }
    outputs["stream"] = ["images", "tokens", last.heads * last.size]
    return join(graph, {"image": (FLOAT, ["images", 3, "height", "width"])}, outputs, [*parts, ends], instead)


def _embed(own: _Embedding) -> tuple[Additions, str]:
    """Tokens (B, N, C) of patches (B, C, h, w), with position embeddings interpolated as in transformers."""
    made, dtype, prefix, width = Additions("embedding"), own.positions.dtype, len(own.first), own.positions.shape[1]
    shape = made.add("Shape", own.patches)
    flat = made.add("Reshape", own.patches, made.constant([0, width, -1]))
    patches = made.add("Transpose", flat, perm=[0, 2, 1])
    table = own.positions[prefix:].reshape(own.grid, own.grid, width).transpose(2, 0, 1)[None]
    size = made.add("Slice", shape, made.constant([2]), made.constant([4]))
    fitted = made.add(
        "Resize", made.constant(table, np.float32), "", "",
        made.add("Concat", made.constant([1, width]), size, axis=0), mode="cubic", cubic_coeff_a=_BICUBIC,
        coordinate_transformation_mode="pytorch_half_pixel",
    )  # fmt: skip
    flat = made.add("Reshape", fitted, made.constant([1, width, -1]))
    tokens = made.add("Add", patches, made.cast(made.add("Transpose", flat, perm=[0, 2, 1]), dtype))
    if prefix:
        first = made.constant((own.first + own.positions[:prefix])[None], dtype)
        images = made.add("Slice", shape, made.constant([0]), made.constant([1]))
        each = made.add("Concat", images, made.constant([prefix, width]), axis=0)
        tokens = made.add("Concat", made.add("Expand", first, each), tokens, axis=1)
    return made, tokens


def _split(made: Additions, name: str, heads: int, keys: bool = False) -> str:
    """(B, N, heads d) to (B, heads, N, d), or to (B, heads, d, N) for keys."""
    parts = made.add("Reshape", name, made.constant([0, 0, heads, -1]))
    return made.add("Transpose", parts, perm=[0, 2, 3, 1] if keys else [0, 2, 1, 3])


def _attend(own: _Attention, prefix: str) -> tuple[Additions, str]:
    """Softmax attention (B, N, heads d) of any number of tokens."""
    made = Additions(prefix)
    q, k, v = (made.cast(_split(made, name, own.heads, name == own.projected[1]), own.dtype) for name in own.projected)
    scores = made.add("MatMul", made.add("Mul", q, made.constant(own.size**-0.5, own.dtype)), k)
    mixed = made.add("MatMul", made.add("Softmax", scores, axis=-1), v)
    joined = made.add("Transpose", mixed, perm=[0, 2, 1, 3])
    return made, made.add("Reshape", joined, made.constant([0, 0, own.heads * own.size]))


@dataclass(frozen=True)
class Tail:
    """What turns the tokens (B, N, C) after the blocks into an embedding (B, D), for any numbers of tokens."""

    start: str
    output: str
    nodes: tuple[onnx.NodeProto, ...]
    freed: dict[str, NDArray[np.int64]]
    """Shape of a reshaping -> what its axes of as many tokens as in training become, and 1 for all others."""

    @classmethod
    def of(
        cls, graph: OnnxGraph, feeds: dict[str, NDArray[Any]], start: str, output: str, tokens: int | None = None
    ) -> Tail:
        """tokens: their number in training, which shapes may state. Raises CutError."""
        inside, needed = graph.descendants([start]), graph.ancestors([output])
        nodes = [
            node for node in graph.nodes if inside.intersection(taken_by(node)) and needed.intersection(node.output)
        ]
        if any(set(taken_by(node)) - set(node.input) for node in nodes):
            raise CutError("it has branches after its blocks")
        shaping = [node.input[:2] for node in nodes if node.op_type == "Reshape"]
        seen = graph.run([name for names in shaping for name in names], feeds)
        freed = {
            name: _free(seen[name], seen[before].shape, tokens)
            for before, name in shaping
            if tokens is not None and tokens in seen[name]
        }
        return cls(start, output, tuple(nodes), freed)

    def add_to(self, made: Additions, begin: str) -> str:
        """Repeats it after another tensor, and returns the name of the embedding."""
        renamed = {self.start: begin}
        for node in self.nodes:
            renamed |= {name: f"{made.prefix}/{name}" for name in node.output if name}
            copied = onnx.NodeProto()
            copied.CopyFrom(node)
            copied.name = f"{made.prefix}/{node.name}"
            copied.input[:] = [renamed.get(name, name) for name in node.input]
            copied.output[:] = [renamed.get(name, name) for name in node.output]
            if node.op_type == "Reshape" and (freed := self.freed.get(node.input[1])) is not None:
                axes = made.constant(freed < 1, np.bool_)
                copied.input[1] = made.add("Where", axes, made.constant(freed), copied.input[1])
            made.nodes.append(copied)
        return renamed[self.output]


def _free(shape: NDArray[Any], before: tuple[int, ...], tokens: int) -> NDArray[np.int64]:
    """What the axes of a shape become, so that any number of tokens can be brought to it: 0 keeps an axis of that
    length, -1 infers it; 1 stands for all others."""
    freed = np.ones(len(shape), np.int64)
    for axis in np.flatnonzero(shape == tokens):
        if axis < len(before) and before[axis] == tokens:
            freed[axis] = 0
        elif -1 not in shape and -1 not in freed:
            freed[axis] = -1
    return freed


def _head_network(graph: OnnxGraph, block: _LastBlock, tail: Tail) -> onnx.ModelProto:
    """The network ``head``. The feature of a token is the embedding of an image with that token alone."""
    ends, float32 = Additions("ends"), np.dtype(np.float32)
    mixed, stream = (ends.cast(*own) for own in zip(("mixed", "stream"), block.dtypes, strict=True))
    size = ends.add("Slice", ends.add("Shape", "stream"), ends.constant([0]), ends.constant([2]))
    back = ends.add("Concat", size, ends.constant([-1]), axis=0)
    width = ends.add("Slice", ends.add("Shape", "stream"), ends.constant([2]), ends.constant([3]))
    alone = ends.add("Concat", ends.constant([-1, 1]), width, axis=0)
    parts = [ends]
    for name, source in (("features", block.after), ("reduced", block.own)):
        part = Additions(name)
        made = tail.add_to(part, part.add("Reshape", source, alone))
        part.cast(part.add("Reshape", made, back), float32, name)
        parts.append(part)
    whole = Additions("pooled of")
    whole.cast(tail.add_to(whole, block.after), float32, "pooled")
    parts.append(whole)
    tokens, each = ["images", "tokens", "width"], ["images", "tokens", "size"]
    return join(
        graph, {"mixed": (FLOAT, tokens), "stream": (FLOAT, tokens)},
        {"features": each, "reduced": each, "pooled": ["images", "size"]}, parts,
        {block.mixed: mixed, block.stream: stream},
    )  # fmt: skip


def _check(cut: VisionCut, images: NDArray[np.float32], expected: NDArray[Any], tolerance: float) -> None:
    """Raises CutError if the networks give another embedding than the original, or fail on images of another size."""
    found, wanted = _pooled(cut, images), expected.astype(np.float32)
    units = [own / np.linalg.norm(own, axis=-1, keepdims=True) for own in (found, wanted)]
    if not (error := np.linalg.norm(units[0] - units[1], axis=-1).max()) <= tolerance:
        raise CutError(f"its parts give another embedding, {error:.2g} from that of the whole graph")
    _pooled(cut, images[:1, :, cut.patch :])


def _pooled(cut: VisionCut, images: NDArray[np.float32]) -> NDArray[np.float32]:
    """The embeddings (B, D) that the networks give together. Raises CutError."""
    q, k, v, stream = run_model(cut.image, ["queries", "keys", "values", "stream"], {"image": images})
    grid = images.shape[2] // cut.patch, images.shape[3] // cut.patch
    mixed = clip_attention.mix_values("plain", q, k, v, grid)
    names = ["features", "reduced", "pooled"]
    features, reduced, pooled = run_model(cut.head, names, {"mixed": mixed, "stream": stream})
    tokens = len(images), cut.prefix_tokens + grid[0] * grid[1], cut.dimension
    if features.shape != tokens or reduced.shape != tokens or pooled.shape != (len(images), cut.dimension):
        raise CutError("its parts do not give a feature for each patch")
    return pooled
