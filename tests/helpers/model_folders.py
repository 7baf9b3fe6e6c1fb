"""Small model packages, written to a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import tiny_models
import yaml
from onnx import TensorProto, helper, numpy_helper

from freeocc3d.cli.main import main
from freeocc3d.language import model_packages


def graph(path: Path, inputs: dict[str, list[Any]], outputs: dict[str, list[Any]]) -> None:
    """An ONNX network that ignores its inputs and gives zeros."""
    nodes, constants = [], []
    for name, shape in outputs.items():
        zeros = np.zeros([n if isinstance(n, int) else 1 for n in shape], np.float32)
        constants.append(numpy_helper.from_array(zeros, f"{name}_zeros"))
        nodes.append(helper.make_node("Identity", [f"{name}_zeros"], [name]))
    made = helper.make_graph(
        nodes, "g",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in inputs.items()],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in outputs.items()],
        constants,
    )  # fmt: skip
    onnx.save(helper.make_model(made, opset_imports=[helper.make_opsetid("", 18)], ir_version=10), path)


def dense_package(folder: Path, **changes: Any) -> Path:
    """The smallest package with a text side."""
    folder.mkdir(parents=True)
    graph(folder / "image.onnx", {"image": ["b", 3, "h", "w"]}, {"features": [1, 2, 2, 8]})
    graph(folder / "text.onnx", {"tokens": ["t", "l"]}, {"features": [1, 8]})
    (folder / "tokenizer.json").write_text(tiny_models.tokenizer(), encoding="utf-8")
    write_manifest(folder, **changes)
    return folder


def write_manifest(folder: Path, **changes: Any) -> None:
    parts = {"image": "image.onnx", "text": "text.onnx", "tokenizer": "tokenizer.json"}
    manifest = {
        "format": 1, "name": folder.name, "kind": "dense", "dimension": 8, "mean": [0.5] * 3, "std": [0.5] * 3,
        "patch": 14, "input_size": 224, "prefix_tokens": 0, "logit_scale": 100, "precision": "fp32", "licence": "none",
        "source": "a test", "parts": parts,
        "files": {file: model_packages.hash_file(folder / file) for file in parts.values()}, **changes,
    }  # fmt: skip
    (folder / "manifest.yaml").write_text(yaml.safe_dump(manifest), encoding="utf-8")


def succeed(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 0
