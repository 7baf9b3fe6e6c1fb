"""Writes a checkpoint's networks as a model package."""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import torch
import yaml

from ...core.errors import ModelError
from .. import model_packages
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
    if folder.exists():
        raise ModelError(f"{folder} already exists: choose another folder for the package.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
        made = Path(temporary) / "package"
        made.mkdir()
        parts = {}
        for part, network in checkpoint.networks.items():
            parts[part] = f"{part}.onnx"
            write_onnx(network, made / parts[part])
            change_precision(made / parts[part], precision)
        if checkpoint.tokenizer is not None:
            parts["tokenizer"] = "tokenizer.json"
            (made / parts["tokenizer"]).write_text(checkpoint.tokenizer, encoding="utf-8")
        manifest = {
            "format": model_packages.FORMAT,
            "name": name,
            "kind": checkpoint.kind,
            **checkpoint.facts,
            "precision": precision,
            "licence": licence,
            "source": source,
            "parts": parts,
            "files": {file: model_packages.hash_file(made / file) for file in parts.values()},
        }
        (made / model_packages.MANIFESTS[0]).write_text(yaml.safe_dump(manifest, sort_keys=False), encoding="utf-8")
        package = model_packages.read_package(made)
        for part in checkpoint.networks:
            package.session(part)  # fails if the written network cannot run
        os.replace(made, folder)


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
