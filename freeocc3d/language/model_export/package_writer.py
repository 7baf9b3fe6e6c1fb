"""Writes a checkpoint's networks as a model package."""

from __future__ import annotations

import contextlib
import functools
import logging
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import torch

from .. import model_packages
from ..package_files import write_files
from .checkpoint_networks import Checkpoint, CheckpointNetwork

_OPSET = 18
"""Version of ONNX's operators: the newest that every supported onnxruntime runs."""

LARGEST = (1 << 31) - (1 << 26)
"""Bytes of weights that fit into one file: ONNX's end at 2 GiB, and graphs need some."""


def write_package(
    checkpoint: Checkpoint,
    folder: Path,
    name: str,
    source: str,
    licence: str,
    precision: model_packages.Precision = "fp32",
) -> None:
    """Writes a package, completely or not at all. Raises ModelError."""

    def write(network: CheckpointNetwork, path: Path) -> None:
        if precision == "fp32":
            write_onnx(network, path)
            return
        with tempfile.TemporaryDirectory(dir=path.parent) as temporary:
            write_onnx(network, whole := Path(temporary) / path.name)
            change_precision(whole, path, precision, _is_large(network))

    networks = {part: functools.partial(write, network) for part, network in checkpoint.networks.items()}
    manifest = {
        "name": name, "kind": checkpoint.kind, **checkpoint.facts, "precision": precision, "licence": licence,
        "source": source,
    }  # fmt: skip
    write_files(folder, manifest, networks, checkpoint.tokenizer)


def _is_large(network: CheckpointNetwork) -> bool:
    """Whether its weights do not fit into the file of its graph."""
    tensors = (*network.module.parameters(), *network.module.buffers())
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors) > LARGEST


def write_onnx(network: CheckpointNetwork, path: Path) -> None:
    """Exports one network. Large weights are in a file beside it."""
    any_length = {
        name: dict.fromkeys(network.dynamic.get(name, ()), torch.export.Dim.DYNAMIC) for name in network.inputs
    }
    with _silent_exporter(), torch.no_grad():
        torch.onnx.export(
            network.module.eval(), tuple(network.inputs.values()), str(path), input_names=list(network.inputs),
            output_names=list(network.outputs), dynamic_shapes=any_length, dynamo=True,
            external_data=_is_large(network), opset_version=_OPSET, verbose=False,
        )  # fmt: skip


@contextlib.contextmanager
def _silent_exporter() -> Iterator[None]:
    """Silences torch's exporter, which warns and logs the number of skipped operators."""
    log = logging.getLogger()
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def change_precision(whole: Path, path: Path, precision: model_packages.Precision, large: bool) -> None:
    """Writes a network in another precision. fp16 halves weights and sums. int8 quantizes the weights of matrix
    products, with one scale per column, and their inputs at run time. Inputs and outputs stay float32. large: weights
    go to a file beside it."""
    if precision == "fp16":
        import onnx
        from onnxruntime.transformers.float16 import convert_float_to_float16

        made = convert_float_to_float16(str(whole), keep_io_types=True)
        onnx.save(made, path, save_as_external_data=large, location=f"{path.name}.data")
    else:
        from onnxruntime.quantization import QuantType, quantize_dynamic

        quantize_dynamic(
            whole, path, op_types_to_quantize=["MatMul", "Gemm"], per_channel=True, weight_type=QuantType.QInt8,
            use_external_data_format=large, extra_options={"MatMulConstBOnly": True},
        )  # fmt: skip
