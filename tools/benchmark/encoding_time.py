"""What a run's encoding takes with a quantized CLIP ViT-B/16 of random weights, as ready-made exports hold it."""

from __future__ import annotations

import functools
import json
import logging
import tempfile
import warnings
from pathlib import Path
from typing import Any

from .figures import Figures, Line
from .processes import COMMAND, run_inside, run_timed
from .timing import time_fastest

WIDTH, LAYERS, FORWARD, PATCH, SIDE, DIMENSION = 768, 12, 3072, 16, 224, 512
"""ViT-B/16."""
FRAME = 480, 640
RUNS = 5
_SHARE = 1 / 3


def measure_encoding(capture: str) -> Figures:
    """Tokens, operations and seconds of a keyframe, and seconds by stage of a run of the capture."""
    with tempfile.TemporaryDirectory() as folder:
        run_inside("encoding_time:write_package", folder=folder)
        keyframe = run_inside("encoding_time:time_keyframe", folder=folder)
        out = str(Path(folder) / "map")
        model = f"--set=language.clip.model={folder}/package"
        run_timed([*COMMAND, "reconstruct", capture, "-o", out, "--set=language.encoder=clip", model])
        facts = json.loads(run_timed([*COMMAND, "info", out, "--json"])[2])
    return {"keyframe": keyframe, "seconds": facts["seconds"]}


def write_package(folder: str) -> Figures:
    """Writes an export of the network, as ``optimum`` does, and ``package``, made of it. The text tower is small."""
    import torch
    from onnxruntime.quantization import QuantType, quantize_dynamic
    from tokenizers import pre_tokenizers
    from torch import Tensor, nn
    from transformers import CLIPConfig, CLIPModel

    from freeocc3d.language.model_export.tokenizer_files import clip_tokenizer_from
    from freeocc3d.language.ready_made.export_layout import WORD_GRAPHS, graph_names
    from freeocc3d.language.ready_made.export_packages import package_of_export

    logging.disable()
    warnings.simplefilter("ignore")
    letters = pre_tokenizers.ByteLevel.alphabet()
    tokens = [*letters, *(letter + "</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    small = {"hidden_size": 64, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    end = len(tokens) - 1
    text = {**small, "vocab_size": len(tokens), "bos_token_id": end - 1, "eos_token_id": end, "pad_token_id": end}
    vision = {"hidden_size": WIDTH, "intermediate_size": FORWARD, "num_hidden_layers": LAYERS, "patch_size": PATCH}
    torch.manual_seed(0)
    model = CLIPModel(CLIPConfig(projection_dim=DIMENSION, vision_config=vision, text_config=text)).eval()

    class Tower(nn.Module):
        def __init__(self, tower: Any, projection: Any):
            super().__init__()
            self.tower, self.projection = tower, projection

        def forward(self, given: Tensor) -> Any:
            return self.projection(self.tower(given).pooler_output)

    root = Path(folder)
    (root / "onnx").mkdir()
    images, texts = torch.zeros(2, 3, SIDE, SIDE), torch.ones((2, 77), dtype=torch.int64)
    towers = (
        (Tower(model.vision_model, model.visual_projection), images, "pixel_values", "image_embeds"),
        (Tower(model.text_model, model.text_projection), texts, "input_ids", "text_embeds"),
    )
    for path, (tower, given, name, output) in zip(graph_names(WORD_GRAPHS, "int8"), towers, strict=True):
        whole = root / "whole.onnx"
        axes = {name: {0: "batch"} | ({1: "length"} if name == "input_ids" else {}), output: {0: "batch"}}
        with torch.no_grad():
            torch.onnx.export(
                tower, (given,), str(whole), input_names=[name], output_names=[output], dynamic_axes=axes,
                opset_version=14, dynamo=False,
            )  # fmt: skip
        quantize_dynamic(whole, root / path, per_channel=True, weight_type=QuantType.QUInt8)
    (root / "config.json").write_text('{"model_type": "clip"}')
    (root / "preprocessor_config.json").write_text("{}")
    (root / "tokenizer.json").write_text(clip_tokenizer_from({token: n for n, token in enumerate(tokens)}, []))
    package_of_export(root, root / "package", "random weights", "int8")
    return {}


def time_keyframe(folder: str) -> Figures:
    """Windows, tokens, operations and fastest seconds of a keyframe, and float32 operations a second of a product."""
    import numpy as np

    from freeocc3d.core.types import Frame, Intrinsics
    from freeocc3d.language.encoders import clip
    from freeocc3d.language.patch_features import Tiling

    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (*FRAME, 3), dtype=np.uint8)
    frame = Frame(0, 0.0, rgb, np.ones(FRAME, np.float32), Intrinsics(FRAME[1], FRAME[0], 500.0, 500.0, 320.0, 240.0))
    encoder = clip.load(clip.Options(model=f"{folder}/package"))
    tiling = Tiling.of(*FRAME, encoder.package, encoder.options.short_side, SIDE)
    windows, tokens = len(tiling.tops) * len(tiling.lefts), 1 + tiling.window[0] * tiling.window[1]
    weights = LAYERS * (4 * WIDTH**2 + 2 * WIDTH * FORWARD) + WIDTH * 3 * PATCH**2 + WIDTH * DIMENSION
    a, b = (rng.normal(size=size).astype(np.float32) for size in ((windows * tokens, WIDTH), (WIDTH, FORWARD)))
    return {
        "windows": windows,
        "tokens": windows * tokens,
        "operations": windows * tokens * (2 * weights + 4 * LAYERS * tokens * WIDTH),
        "seconds": time_fastest(functools.partial(encoder.encode, frame), RUNS),
        "float_operations_per_second": 2 * a.size * FORWARD / time_fastest(lambda: a @ b, RUNS),
    }


def encoding_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    own, seconds = figures["keyframe"], figures["seconds"]
    speed = own["operations"] / own["seconds"]
    return [
        (
            "a keyframe through the quantized B/16",
            f"{own['windows']} windows, {own['tokens']} tokens, {1e-9 * own['operations']:.0f} GFLOP in "
            f"{own['seconds']:.2f} s: {1e-9 * speed:.0f} GFLOP/s, {speed / own['float_operations_per_second']:.1f} of "
            "a float32 product's",
            "–",
        ),
        (
            "its share of a run",
            f"{seconds['language'] / sum(seconds.values()):.2f} ({seconds['language']:.1f} of "
            f"{sum(seconds.values()):.1f} s)",
            f"≤ {_SHARE:.2f}",
        ),
    ]
