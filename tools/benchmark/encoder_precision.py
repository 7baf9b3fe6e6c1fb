"""What each precision of a model package costs and loses, and what guided upsampling gains at the edges of class
images.

The network is a small CLIP with random weights. Its size and speed are those of any network of its shape; the losses of
int8 and fp16 may differ with real weights."""

from __future__ import annotations

import os
import statistics
import tempfile
from functools import partial
from pathlib import Path
from typing import Any, get_args

from .figures import Figures, Line
from .timing import time_fastest

SHAPE = {"hidden_size": 384, "num_hidden_layers": 6, "num_attention_heads": 6, "intermediate_size": 1536}
"""Shape of the image and the text tower: a third of ViT-B/16's weights in half of its layers."""
DIMENSION, PATCH = 512, 16
FRAME = 480, 640
WORDS = ("chair", "table", "red sofa", "a plant on the window sill")
RUNS = 7
_EDGE_PIXELS, _STRIDE = 16, 4


def measure_encoders() -> Figures:
    """Bytes, seconds and cosines to fp32 of each precision; shares of pixels near edges that get their class."""
    import numpy as np

    from freeocc3d.core.types import Frame, Intrinsics
    from freeocc3d.language import model_packages
    from freeocc3d.language.encoders import clip
    from freeocc3d.language.model_export.package_writer import write_package
    from freeocc3d.language.text_networks import TextNetwork

    rgb = np.random.default_rng(0).integers(0, 256, (FRAME[0] // 32, FRAME[1] // 32, 3), dtype=np.uint8)
    rgb = np.ascontiguousarray(rgb.repeat(32, axis=0).repeat(32, axis=1))
    camera = Intrinsics(FRAME[1], FRAME[0], 500.0, 500.0, 320.0, 240.0)
    frame = Frame(0, 0.0, rgb, np.ones(FRAME, np.float32), camera)
    rows: list[Figures] = []
    exact: tuple[Any, Any] | None = None
    with tempfile.TemporaryDirectory() as folder:
        os.environ["FREEOCC3D_MODELS"] = folder
        checkpoint = _checkpoint()
        for precision in get_args(model_packages.Precision):
            path = Path(folder) / precision
            write_package(checkpoint, path, precision, "random weights", "none", precision)
            package = model_packages.read_package(path)
            encoder = clip.load(clip.Options(model=str(path)))
            text = TextNetwork(package)
            patches, words = encoder.patches(rgb), text.embed(list(WORDS))
            exact = exact or (patches, words)
            rows.append(
                {
                    "precision": precision,
                    "bytes": package.bytes,
                    "frame_seconds": time_fastest(partial(encoder.patches, rgb), RUNS),
                    "upsampled_frame_seconds": time_fastest(partial(encoder.encode, frame), RUNS),
                    "text_seconds": time_fastest(partial(text.embed, list(WORDS)), RUNS) / len(WORDS),
                    "patch_cosine": float((patches * exact[0]).sum(axis=-1).min()),
                    "text_cosine": float((words * exact[1]).sum(axis=-1).min()),
                }
            )
    return {"frame": list(FRAME), "rows": rows, "edges": measure_edges()}


def _checkpoint() -> Any:
    import torch
    from tokenizers import pre_tokenizers
    from transformers import CLIPConfig, CLIPModel

    from freeocc3d.language.model_export.checkpoint_networks import build_clip
    from freeocc3d.language.model_export.tokenizer_files import clip_tokenizer_from

    letters = pre_tokenizers.ByteLevel.alphabet()
    tokens = [*letters, *(letter + "</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    vocabulary = {token: number for number, token in enumerate(tokens)}
    own = {"projection_dim": DIMENSION}
    text = {**SHAPE, **own, "vocab_size": len(tokens), "eos_token_id": len(tokens) - 1, "bos_token_id": len(tokens) - 2,
            "pad_token_id": len(tokens) - 1}  # fmt: skip
    torch.manual_seed(0)
    model = CLIPModel(
        CLIPConfig(**own, vision_config={**SHAPE, **own, "patch_size": PATCH, "image_size": 224}, text_config=text)
    ).eval()
    tokenizer = clip_tokenizer_from(vocabulary, [])
    return build_clip(model, tokenizer, [0.5] * 3, [0.25] * 3)


def measure_edges() -> Figures:
    """Averages class images of the built-in room over patches and upsamples them: the share of the pixels near an edge
    that get their class from the nearest patch, linearly between patches, and guided by the image."""
    import cv2
    import numpy as np

    from freeocc3d.capture import open_capture
    from freeocc3d.language.guided_upsampling import upsample_features
    from freeocc3d.language.patch_features import normalize_patches, resample_patches

    capture = open_capture("builtin:room")
    names = normalize_patches(np.random.default_rng(0).normal(size=(len(capture.classes), 64)).astype(np.float32))
    right: dict[str, list[float]] = {"nearest": [], "linear": [], "guided": []}
    for index in range(10, len(capture), 40):
        labels = capture.labels(index)
        assert labels is not None
        (height, width), window = labels.shape, 2 * _EDGE_PIXELS + 1
        blocks = names[labels].reshape(height // PATCH, PATCH, width // PATCH, PATCH, -1)
        patches = normalize_patches(blocks.mean(axis=(1, 3)))
        edges = (cv2.Laplacian(labels.astype(np.float32), cv2.CV_32F) != 0).astype(np.uint8)
        near = cv2.dilate(edges, np.ones((window, window)))[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE] > 0
        true = labels[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE]
        share = PATCH // _STRIDE
        found = {
            "nearest": patches.repeat(share, axis=0).repeat(share, axis=1),
            "linear": resample_patches(patches, true.shape),
            "guided": upsample_features(patches, capture[index].color, _STRIDE).astype(np.float32),
        }
        for way, features in found.items():
            right[way].append(float(((features @ names.T).argmax(axis=-1) == true)[near].mean()))
    return {way: statistics.mean(shares) for way, shares in right.items()}


def encoders_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    height, width = figures["frame"]
    lines: list[Line] = []
    for row in figures["rows"]:
        seconds = (row[name] for name in ("frame_seconds", "upsampled_frame_seconds", "text_seconds"))
        frame_ms, upsampled_ms, prompt_ms = (f"{1e3 * value:.1f} ms" for value in seconds)
        cosines = f"patches {row['patch_cosine']:.4f}, words {row['text_cosine']:.4f}"
        measured = (
            f"{row['bytes'] / 1e6:.1f} MB; {width} x {height} pixels {frame_ms}, upsampled {upsampled_ms}; "
            f"a prompt {prompt_ms}; smallest cosine to fp32: {cosines}"
        )
        lines.append((f"clip, {row['precision']}", measured, ""))
    edges = figures["edges"]
    shares = ", ".join(f"{way} {100 * share:.1f} %" for way, share in edges.items())
    return [*lines, (f"pixels within {_EDGE_PIXELS} of an edge that get their class", shares, "")]
