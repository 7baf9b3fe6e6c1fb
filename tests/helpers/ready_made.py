"""Tiny networks as ready-made ONNX exports: the graphs that optimum's exporter writes, in transformers.js's layout."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import onnx
import pytest
import tiny_models
import torch
from made_once import make_once
from torch import Tensor, nn

NAMES = {"clip": ("image_embeds", "text_embeds"), "siglip": ("pooler_output", "pooler_output")}
LENGTH = {"clip": 77, "siglip": 16}
SUFFIX = {"fp32": "", "fp16": "_fp16", "int8": "_quantized"}


class Vision(nn.Module):
    """What the classes …VisionModel(WithProjection) of transformers return."""

    def __init__(self, model: Any):
        super().__init__()
        self.vision, self.projection = model.vision_model, getattr(model, "visual_projection", None)

    def forward(self, pixel_values: Tensor) -> Any:
        found = self.vision(pixel_values=pixel_values)
        return self.projection(found.pooler_output) if self.projection else found.to_tuple()[:2]


class Text(nn.Module):
    """What the classes …TextModel(WithProjection) return; extra: take an unused image, and a mask, as well."""

    def __init__(self, model: Any):
        super().__init__()
        self.text, self.projection = model.text_model, getattr(model, "text_projection", None)

    def forward(self, input_ids: Tensor) -> Any:
        found = self.text(input_ids=input_ids)
        return self.projection(found.pooler_output) if self.projection else found.to_tuple()[:2]


def model_of(kind: str, attention: str = "sdpa") -> Any:
    model = getattr(tiny_models, kind)()
    model.set_attn_implementation(attention)
    return model


def copy_export(factory: pytest.TempPathFactory, target: Path, kind: str, precision: str, attention: str) -> Path:
    """A copy of an export that is written once for all tests."""
    name = f"export-{kind}-{precision}-{attention}"
    made = make_once(factory, name, lambda path: write_export(path, kind, precision, attention))
    return Path(shutil.copytree(made, target))


def write_export(folder: Path, kind: str, precision: str = "fp32", attention: str = "sdpa") -> Path:
    """A folder with the export of a tiny CLIP or SigLIP."""
    (folder / "onnx").mkdir(parents=True)
    model = model_of(kind, attention)
    image, tokens = torch.zeros((2, 3, 32, 32)), torch.ones((2, LENGTH[kind]), dtype=torch.int64)
    for part, own, given, at in (("vision", Vision(model), image, 0), ("text", Text(model), tokens, 1)):
        name = "pixel_values" if part == "vision" else "input_ids"
        outputs = [NAMES[kind][at]] if kind == "clip" else ["last_hidden_state", NAMES[kind][at]]
        path = folder / "onnx" / f"{part}_model.onnx"
        axes = dict(enumerate(("batch", "channels", "height", "width") if part == "vision" else ("batch", "sequence")))
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            torch.onnx.export(
                own.eval(), (given,), str(path), input_names=[name], output_names=outputs, opset_version=14,
                dynamic_axes={name: axes, **{output: {0: "batch"} for output in outputs}}, dynamo=False,
            )  # fmt: skip
        convert(path, precision)
    side = {"height": 32, "width": 32}
    text = {"max_position_embeddings": LENGTH[kind], "pad_token_id": 1}
    (folder / "config.json").write_text(json.dumps({"model_type": kind, "text_config": text}))
    means = {"image_mean": [0.5, 0.4, 0.3], "image_std": [0.5, 0.4, 0.3]}
    (folder / "preprocessor_config.json").write_text(json.dumps({**means, "size": side, "do_resize": True}))
    (folder / "tokenizer.json").write_text(tiny_models.tokenizer())
    (folder / "README.md").write_text("---\nlicense: mit\n---\n")
    return folder


def convert(path: Path, precision: str) -> None:
    """Replaces a graph in fp32 by one of the precision, with its suffix."""
    target = path.with_name(f"{path.stem}{SUFFIX[precision]}.onnx")
    if precision == "fp16":
        from onnxruntime.transformers.float16 import convert_float_to_float16

        onnx.save(convert_float_to_float16(onnx.load(path), keep_io_types=True), target)
    elif precision == "int8":
        from onnxruntime.quantization import QuantType, quantize_dynamic

        quantize_dynamic(path, target, per_channel=True, weight_type=QuantType.QUInt8)
    if precision != "fp32":
        path.unlink()
