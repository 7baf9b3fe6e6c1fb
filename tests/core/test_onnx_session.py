"""Networks from anybody: what they do wrong is told with their path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper
from onnx_models import write_identity, write_model

from freeocc3d.core.errors import ModelError
from freeocc3d.core.onnx_files import find_external_files
from freeocc3d.core.onnx_session import load_network


def test_a_network_gives_its_outputs(tmp_path: Path) -> None:
    network = load_network(write_identity(tmp_path / "a.onnx", [1, 3, "h", "w"]))
    image = np.random.default_rng(0).random((1, 3, 4, 5), np.float32)
    (found,) = network.run(["out"], {"image": image}, {"out": (1, 3, None, 5)})
    assert np.array_equal(found, image)
    assert (list(network.inputs), list(network.outputs)) == (["image"], ["out"])


@pytest.mark.parametrize(
    ("image", "shape", "told"),
    [
        (np.zeros((1, 3, 4)), (1, 3, 4, 4), r"fails on image \(1, 3, 4\)"),
        (np.zeros((1, 3, 4, 4), np.uint8), (1, 3, 4, 4), "fails on image"),
        (np.zeros((1, 3, 4, 4), np.float32), (1, 3, 4, None, 1), r"of \(1, 3, 4, 4\) instead of \(1, 3, 4, any, 1\)"),
        (np.zeros((1, 3, 4, 4), np.float32), (1, 3, 5, 4), "gives 'out' of"),
        (np.full((1, 3, 4, 4), np.nan, np.float32), (1, 3, 4, 4), "not finite"),
        (np.full((1, 3, 4, 4), -np.inf, np.float32), (1, 3, 4, 4), "not finite"),
    ],
)  # fmt: skip
def test_what_it_does_wrong(tmp_path: Path, image: Any, shape: Any, told: str) -> None:
    network = load_network(write_identity(tmp_path / "a.onnx", [1, 3, "h", "w"]))
    with pytest.raises(ModelError, match=rf"a\.onnx.*{told}"):
        network.run(["out"], {"image": image}, {"out": shape})


def test_text_is_no_output(tmp_path: Path) -> None:
    network = load_network(write_identity(tmp_path / "a.onnx", ["n"], TensorProto.STRING))
    with pytest.raises(ModelError, match="something else than numbers"):
        network.run(["out"], {"image": np.array(["a", "b"], object)})


@pytest.mark.parametrize("shape", [[1, 3, 1 << 20, 1 << 20], [1, 3, 1 << 40, "w"], [1, 3, 0, 4]])
def test_an_input_that_no_image_fits(tmp_path: Path, shape: list[Any]) -> None:
    with pytest.raises(ModelError, match=r"a\.onnx states an input 'image' of"):
        load_network(write_identity(tmp_path / "a.onnx", shape))


def made_of(path: Path, kind: str, constant: bool, shape: list[int]) -> Path:
    """A network that makes a tensor of a constant shape, from an initializer or a node."""
    stated = numpy_helper.from_array(np.array(shape, np.int64), "shape")
    nodes = [helper.make_node("Constant", [], ["shape"], value=stated)] if constant else []
    first = ["shape"] if kind == "ConstantOfShape" else ["image", "shape"]
    nodes.append(helper.make_node(kind, first, ["out"]))
    axes = {"image": [1, 1], "out": ["a", "b"]}
    described = [helper.make_tensor_value_info(name, TensorProto.FLOAT, own) for name, own in axes.items()]
    return write_model(path, nodes, described[:1], described[1:], [] if constant else [stated])


@pytest.mark.parametrize("kind", ["ConstantOfShape", "Expand", "Tile"])
@pytest.mark.parametrize("constant", [False, True])
def test_a_tensor_that_fills_the_memory_is_refused_before(tmp_path: Path, kind: str, constant: bool) -> None:
    with pytest.raises(ModelError, match=r"makes a tensor of 1,099,511,627,776 numbers"):
        load_network(made_of(tmp_path / "a.onnx", kind, constant, [1 << 20, 1 << 20]))
    assert load_network(made_of(tmp_path / "b.onnx", kind, constant, [2, 3])).outputs


@pytest.mark.parametrize("cut", [0, 1, 10, 100, -1])
def test_damaged_files_are_no_networks(tmp_path: Path, cut: int) -> None:
    path = write_identity(tmp_path / "a.onnx", [1, 3, "h", "w"])
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(ModelError, match=r"a\.onnx is not an ONNX network"):
        load_network(path)


@pytest.mark.parametrize("content", [b"\xff" * 100, b"\x3a\xff\xff\xff\xff\x0f", b"\x3a\x02" * 999, b"x"])
def test_bytes_that_are_no_messages_are_no_network(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.onnx").write_bytes(content)
    with pytest.raises(ModelError, match=r"a\.onnx is not an ONNX network"):
        find_external_files(tmp_path / "a.onnx")


def test_zeros_name_no_files_and_are_no_network(tmp_path: Path) -> None:
    (tmp_path / "a.onnx").write_bytes(bytes(50))
    assert find_external_files(tmp_path / "a.onnx") == []
    with pytest.raises(ModelError, match=r"a\.onnx is not an ONNX network"):
        load_network(tmp_path / "a.onnx")


def test_deep_nesting_ends(tmp_path: Path) -> None:
    inner = b""
    for _ in range(3000):  # graph, node, attribute, graph …
        for tag in (b"\x0a", b"\x2a", b"\x32"):
            size, varint = len(inner), b""
            while size > 127:
                varint, size = varint + bytes([size & 127 | 128]), size >> 7
            inner = tag + varint + bytes([size]) + inner
    (tmp_path / "a.onnx").write_bytes(b"\x3a" + inner[1:])
    with pytest.raises(ModelError, match="is not an ONNX network"):
        load_network(tmp_path / "a.onnx")
