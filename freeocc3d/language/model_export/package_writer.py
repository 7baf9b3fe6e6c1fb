"""Writes a checkpoint's networks as a model package."""

from __future__ import annotations

import contextlib
import functools
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path

import torch

from .. import model_packages
from ..package_files import write_files
from .checkpoint_networks import Checkpoint, CheckpointNetwork

_OPSET = 18
"""Version of ONNX's operators: the newest that every supported onnxruntime runs."""


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
        write_onnx(network, path)
        change_precision(path, precision)

    networks = {part: functools.partial(write, network) for part, network in checkpoint.networks.items()}
    manifest = {
        "name": name, "kind": checkpoint.kind, **checkpoint.facts, "precision": precision, "licence": licence,
        "source": source,
    }  # fmt: skip
    write_files(folder, manifest, networks, checkpoint.tokenizer)


def write_onnx(network: CheckpointNetwork, path: Path) -> None:
    """Exports one network."""
    any_length = {
        name: dict.fromkeys(network.dynamic.get(name, ()), torch.export.Dim.DYNAMIC) for name in network.inputs
    }
    with _silent_exporter(), torch.no_grad():
        torch.onnx.export(
            network.module.eval(), tuple(network.inputs.values()), str(path), input_names=list(network.inputs),
            output_names=list(network.outputs), dynamic_shapes=any_length, dynamo=True, external_data=False,
            opset_version=_OPSET, verbose=False,
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


def change_precision(path: Path, precision: model_packages.Precision) -> None:
    """Changes the precision of a written network. fp16 halves weights and sums. int8 quantizes the weights of matrix
    products, with one scale per column, and their inputs at run time. Inputs and outputs stay float32."""
    if precision == "fp16":
        import onnx
        from onnxruntime.transformers.float16 import convert_float_to_float16

        onnx.save(convert_float_to_float16(onnx.load(path), keep_io_types=True), path)
    elif precision == "int8":
        from onnxruntime.quantization import QuantType, quantize_dynamic

        whole = path.with_suffix(".fp32.onnx")
        path.rename(whole)
        quantize_dynamic(
            whole, path, op_types_to_quantize=["MatMul", "Gemm"], per_channel=True, weight_type=QuantType.QInt8,
            extra_options={"MatMulConstBOnly": True},
        )  # fmt: skip
        whole.unlink()
