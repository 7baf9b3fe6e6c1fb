"""Exports each tiny network once for all tests."""

from __future__ import annotations

import functools
import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from made_once import make_once


@pytest.fixture(scope="session", autouse=True)
def _exported_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Torch's exporter takes seconds for each network; several files of tests write packages with the same ones."""
    from freeocc3d.language.model_export import package_writer

    export = package_writer.write_onnx

    @functools.wraps(export)
    def write_onnx(network: package_writer.CheckpointNetwork, path: Path) -> None:
        name = f"{_hash(network)}.onnx"
        shutil.copy(make_once(tmp_path_factory, name, lambda made: export(network, made)), path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(package_writer, "write_onnx", write_onnx)
        yield


def _hash(network: Any) -> str:
    """Of all that an export depends on: modules, their numbers and weights, and the inputs."""
    found = hashlib.sha256(repr((network.dynamic, network.outputs)).encode())
    for name, module in network.module.eval().named_modules():
        plain = {
            key: repr(value) for key, value in vars(module).items() if isinstance(value, int | float | str | tuple)
        }
        found.update(repr((name, type(module), sorted(plain.items()), repr(getattr(module, "config", "")))).encode())
    tensors = (*network.module.named_parameters(), *network.module.named_buffers(), *network.inputs.items())
    for name, tensor in tensors:
        found.update(repr((name, tensor.shape, tensor.dtype)).encode() + tensor.detach().numpy().tobytes())
    return found.hexdigest()
