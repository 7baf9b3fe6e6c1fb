"""Damaged and hostile model packages, networks for depth, segmentation and local features."""

from __future__ import annotations

import functools
import hashlib
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import yaml
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.depth.depth_network import load_depth_network
from freeocc3d.language import model_packages
from freeocc3d.language.encoders import clip, dinov2, seem, segmenter
from freeocc3d.language.lifting import encode_finite
from freeocc3d.language.text_networks import ModelWords, TextNetwork
from freeocc3d.tracking.sfm.local_features import KeypointNetwork

from . import mutators
from .harness import Attack, Silent

SHORT = 60

_D, _WORDS, _PATCH = 8, 40, 8
_F, _I = TensorProto.FLOAT, TensorProto.INT64
_FRAME = Frame(
    0, 0.0, np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8), np.ones((24, 32), np.float32),
    Intrinsics(32, 24, 30.0, 30.0, 15.5, 11.5),
)  # fmt: skip
_ENCODERS: dict[str, Any] = {"clip": clip, "dense": dinov2, "masks": seem}


def prepare(folder: Path) -> None:
    """A package of each kind with words, and a network of each other kind."""
    for kind in _ENCODERS:
        _package(folder / kind, kind)
    single = folder / "single"
    single.mkdir()
    convolved = [helper.make_node("Conv", ["image", "w"], ["logits"])]
    _save(
        folder / "single" / "segmenter.onnx", convolved, {"logits": (_F, [1, 4, "h", "w"])}, {"w": _random(4, 3, 1, 1)}
    )
    (folder / "single" / "classes.txt").write_text("void\nwall\nchair\nlamp\n")
    near = [helper.make_node("Conv", ["image", "w"], ["depth"])]
    _save(single / "depth.onnx", near, {"depth": (_F, [1, 1, "h", "w"])}, {"w": _random(1, 3, 1, 1)})
    points = [helper.make_node("Identity", [name], [f"{name}s"]) for name in ("keypoint", "descriptor")]
    shapes = {"keypoints": (_F, [1, 5, 2]), "descriptors": (_F, [1, 5, 8])}
    _save(
        folder / "single" / "points.onnx",
        points,
        shapes,
        {"keypoint": _random(1, 5, 2), "descriptor": _random(1, 5, 8)},
    )


def attack(rng: random.Random, originals: Path, folder: Path) -> Attack:
    """One damaged package or network, and all that reads it."""
    kind = rng.choice((*_ENCODERS, "segmenter", "depth", "points"))
    source = originals / (kind if kind in _ENCODERS else "single")
    shutil.copytree(source, folder / "model")
    done = []
    files = sorted(path.name for path in (folder / "model").iterdir())
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice(files if kind in _ENCODERS else [f for f in files if f.startswith((kind, "classes"))])
        if (folder / "model" / name).is_symlink() or not (folder / "model" / name).is_file():
            continue  # an earlier change left nothing to change
        try:
            done.append(f"{name}: {_damage(rng, folder / 'model' / name)}")
        except Exception as error:  # an earlier change left nothing of the kind
            done.append(f"{name}: ({type(error).__name__})")
    if kind in _ENCODERS and rng.random() < 0.85:
        _sign(folder / "model")
    return Attack(f"{kind}; {'; '.join(done)}", functools.partial(_use, kind, folder / "model"))


def _use(kind: str, folder: Path) -> None:
    if kind == "depth":
        found = load_depth_network(folder / "depth.onnx")(_FRAME.color, 32, 24)
    elif kind == "points":
        found = KeypointNetwork(folder / "points.onnx")(_FRAME.color).descriptors
    elif kind == "segmenter":
        options = segmenter.Options(model=str(folder / "segmenter.onnx"), classes=str(folder / "classes.txt"))
        found = encode_finite(segmenter.load(options), _FRAME)
    else:
        module = _ENCODERS[kind]
        model_packages.verify_files(model_packages.read_package(folder))
        encoder = module.load(module.Options(model=str(folder), short_side=24))
        found = encode_finite(encoder, _FRAME)
        words = TextNetwork(encoder.package).embed(["a red chair", "lamp"])
        state = json.loads(json.dumps(encoder.text_state()))
        ModelWords(state).contrast_words()
        if words.shape[1] != found.shape[-1]:
            raise Silent(f"words {words.shape} and pixels {found.shape} are in different spaces")
    if not np.isfinite(found).all():
        raise Silent("features that are not finite")


def _random(*shape: int) -> NDArray[np.float32]:
    return np.random.default_rng(len(shape)).normal(size=shape).astype(np.float32)


def _save(
    path: Path,
    nodes: list[Any],
    outputs: dict[str, tuple[int, list[Any]]],
    constants: dict[str, NDArray[Any]],
    inputs: dict[str, tuple[int, list[Any]]] | None = None,
) -> None:
    inputs = inputs or {"image": (_F, [1, 3, "h", "w"])}
    graph = helper.make_graph(
        nodes, "g",
        [helper.make_tensor_value_info(name, *own) for name, own in inputs.items()],
        [helper.make_tensor_value_info(name, *own) for name, own in outputs.items()],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )  # fmt: skip
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10), path)


def _package(folder: Path, kind: str) -> None:
    folder.mkdir()
    image = {"image": (_F, ["b", 3, "h", "w"])}
    pooled = helper.make_node("AveragePool", ["image"], ["p"], kernel_shape=[_PATCH] * 2, strides=[_PATCH] * 2)
    conv = helper.make_node("Conv", ["p", "w"], ["c"])
    weights = {"w": _random(_D, 3, 1, 1)}
    if kind == "dense":
        last = helper.make_node("Transpose", ["c"], ["features"], perm=[0, 2, 3, 1])
        _save(folder / "image.onnx", [pooled, conv, last], {"features": (_F, ["b", "y", "x", _D])}, weights, image)
    elif kind == "masks":
        weights["e"] = _random(1, _D, _D)
        nodes = [
            pooled,
            helper.make_node("Conv", ["p", "w"], ["masks"]),
            helper.make_node("Identity", ["e"], ["embeddings"]),
        ]
        shapes = {"masks": (_F, ["b", _D, "y", "x"]), "embeddings": (_F, [1, _D, _D])}
        _save(folder / "image.onnx", nodes, shapes, weights, image)
    else:
        flat = [
            helper.make_node("Reshape", ["c", "flat"], ["r"]),
            helper.make_node("Transpose", ["r"], ["stream"], perm=[0, 2, 1]),
        ]
        split = [helper.make_node("Unsqueeze", ["stream", "axis"], [name]) for name in ("queries", "keys", "values")]
        constants = {**weights, "flat": np.array([0, _D, -1]), "axis": np.array([1])}
        shapes = {name: (_F, ["b", 1, "n", _D]) for name in ("queries", "keys", "values")} | {
            "stream": (_F, ["b", "n", _D])
        }
        _save(folder / "image.onnx", [pooled, conv, *flat, *split], shapes, constants, image)
        nodes = [
            helper.make_node("Add", ["mixed", "stream"], ["features"]),
            helper.make_node("Identity", ["mixed"], ["reduced"]),
            helper.make_node("ReduceMean", ["mixed", "axis"], ["pooled"], keepdims=0),
        ]
        shapes = {name: (_F, ["b", "n", _D]) for name in ("features", "reduced")} | {"pooled": (_F, ["b", _D])}
        fed = {name: (_F, ["b", "n", _D]) for name in ("mixed", "stream")}
        _save(folder / "head.onnx", nodes, shapes, {"axis": np.array([1])}, fed)
    nodes = [
        helper.make_node("Gather", ["table", "tokens"], ["t"]),
        helper.make_node("ReduceMean", ["t", "axis"], ["features"], keepdims=0),
    ]
    constants = {"table": _random(_WORDS, _D), "axis": np.array([1])}
    _save(folder / "text.onnx", nodes, {"features": (_F, ["t", _D])}, constants, {"tokens": (_I, ["t", "l"])})
    (folder / "tokenizer.json").write_text(_tokenizer(), encoding="utf-8")
    parts = {name: f"{name}.onnx" for name in model_packages.KINDS[kind]} | {"tokenizer": "tokenizer.json"}
    manifest = {
        "format": 1, "name": kind, "kind": kind, "dimension": _D, "mean": [0.5] * 3, "std": [0.5] * 3, "patch": _PATCH,
        "input_size": 24, "prefix_tokens": 0, "logit_scale": 100, "precision": "fp32", "licence": "none",
        "source": "a test", "parts": parts, "files": dict.fromkeys(parts.values(), ""),
    }  # fmt: skip
    (folder / "manifest.yaml").write_text(yaml.safe_dump(manifest), encoding="utf-8")
    _sign(folder)


def _tokenizer() -> str:
    from tokenizers import Tokenizer, models, pre_tokenizers

    words = ["[PAD]", "[UNK]", "a", "photo", "of", "the", "in", "room", "there", "is", "scene", "red", "chair", "lamp"]
    numbers = {word: number for number, word in enumerate(words)}
    made = Tokenizer(models.WordLevel(numbers, unk_token="[UNK]"))
    made.pre_tokenizer = pre_tokenizers.Whitespace()
    made.enable_padding(length=16)
    made.enable_truncation(16)
    return str(made.to_str())


def _sign(folder: Path) -> None:
    """State the hashes of the files as they are now, so that their content is read."""
    path = folder / "manifest.yaml"
    if not path.is_file() or path.stat().st_size > 1 << 20:
        return
    try:
        manifest = yaml.safe_load(path.read_text(encoding="utf-8"))
        for name in list(manifest["files"]):
            if (folder / name).is_file() and (folder / name).stat().st_size:
                manifest["files"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        path.write_text(yaml.safe_dump(manifest, sort_keys=False), encoding="utf-8")
    except Exception:  # there is no manifest, or none that can be signed
        return


def _damage(rng: random.Random, path: Path) -> str:
    general: list[Callable[[random.Random, Path], str]] = [mutators.change_bytes, mutators.change_kind]
    own: dict[str, Callable[[random.Random, Path], str]] = {
        ".yaml": mutators.change_yaml, ".json": mutators.change_json, ".onnx": _change_network,
        ".txt": mutators.change_lines,
    }  # fmt: skip
    return (rng.choice(general) if rng.random() < 0.3 else own[path.suffix])(rng, path)


def _change_network(rng: random.Random, path: Path) -> str:
    """Change a network as a network: its weights, their shapes, its nodes, inputs and outputs."""
    model = onnx.load(path)
    graph = model.graph
    action = rng.randrange(11)
    what = f"network, kind {action}"
    if action == 0 and graph.initializer:
        tensor = rng.choice(graph.initializer)
        values = numpy_helper.to_array(tensor).copy()
        bad = rng.choice((np.nan, np.inf, -np.inf, 0, 1e38, -1, 2**40))
        values.reshape(-1)[:: rng.choice((1, 3))] = bad if values.dtype.kind == "f" or abs(bad) < 1e20 else 7
        tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))
        what += f": {tensor.name} = {bad}"
    elif action == 1 and graph.initializer:
        tensor = rng.choice(graph.initializer)
        tensor.dims[0] = rng.choice((0, -1, 1, 2**31, 2**62, tensor.dims[0] + 1))
        what += f": {tensor.name} has {list(tensor.dims)}"
    elif action == 2:
        node = rng.choice(graph.node)
        node.op_type = rng.choice(
            ("Identity", "Exp", "Log", "Relu", "ArgMax", "Cast", "Nothing", "", "Shape", "NonZero")
        )
    elif action == 3:
        node = rng.choice(graph.node)
        if node.attribute:
            held = rng.choice(node.attribute)
            held.i = rng.choice((0, -1, 2**40))
            held.ints[:] = [rng.choice((0, -1, 1, 2**31, 3)) for _ in held.ints]
    elif action == 4:
        node = rng.choice(graph.node)
        node.input[0] = rng.choice((node.output[0], "nothing", ""))
    elif action == 5:
        value = rng.choice((*graph.output, *graph.input))
        value.name = rng.choice(("x", "", "features", "\0"))
    elif action == 6:
        value = rng.choice((*graph.output, *graph.input))
        shape = value.type.tensor_type.shape
        if shape.dim:
            rng.choice(shape.dim).dim_value = rng.choice((0, -1, 1, 5, 2**31, 2**60))
        value.type.tensor_type.elem_type = rng.choice((1, 1, 1, 2, 7, 8, 10, 11, 99))
    elif action == 7 and graph.initializer:
        tensor = rng.choice(graph.initializer)
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(
            key="location", value=rng.choice(("../x", "/dev/zero", "/etc/passwd", "a", "", "\0", "."))
        )
        if rng.random() < 0.3:
            tensor.external_data.add(key="length", value=rng.choice(("9" * 30, "-1", "x")))
    elif action == 8:
        size = rng.choice(([2**20, 2**20], [2**62], [-1], [0], [2**15, 2**14], [10**9]))
        graph.initializer.append(numpy_helper.from_array(np.array(size, np.int64), "made_of"))
        old = graph.output[0].name
        for node in graph.node:
            node.output[:] = ["was" if name == old else name for name in node.output]
        graph.node.append(helper.make_node("ConstantOfShape", ["made_of"], [old]))
        what += f": {size}"
    elif action == 9:
        old = graph.output[0].name
        for node in graph.node:
            node.output[:] = ["was" if name == old else name for name in node.output]
        operator = rng.choice(("Log", "Sqrt", "Reciprocal", "IsNaN", "Shape", "NonZero", "Size", "Not"))
        graph.node.append(helper.make_node(operator, ["was"], [old]))
        what += f": {operator}"
    else:
        del graph.node[rng.randrange(len(graph.node))]
    path.write_bytes(model.SerializeToString())
    return what
