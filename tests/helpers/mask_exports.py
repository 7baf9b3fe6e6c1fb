"""Tiny SAMs as ready-made ONNX exports: the graphs that optimum's exporter writes, in transformers.js's layout."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import ready_made
import tiny_models
import torch
from torch import Tensor, nn

SIDE = 64
FEATURES = {
    "sam": ["image_embeddings", "image_positional_embeddings"],
    "sam2": [f"image_embeddings.{level}" for level in range(3)],
}


class Encoder(nn.Module):
    """What an image gives to the decoder."""

    def __init__(self, model: Any):
        super().__init__()
        self.model = model

    def forward(self, pixel_values: Tensor) -> tuple[Tensor, ...]:
        model = self.model
        if hasattr(model, "no_memory_embedding"):
            return tuple(model.get_image_embeddings(pixel_values))
        where = model.get_image_wide_positional_embeddings().repeat(pixel_values.shape[0], 1, 1, 1)
        return model.vision_encoder(pixel_values)[0], where


class Decoder(nn.Module):
    """Masks and scores of points. SAM 2 takes boxes, too."""

    def __init__(self, model: Any):
        super().__init__()
        self.model = model

    def forward(self, points: Tensor, labels: Tensor, *given: Tensor) -> tuple[Tensor, Tensor]:
        model = self.model
        if hasattr(model, "no_memory_embedding"):
            _, *features = given
            sparse, dense = model.prompt_encoder(points, labels, None, None)
            where = model.get_image_wide_positional_embeddings()
            masks, scores, *_ = model.mask_decoder(
                image_embeddings=features[-1], image_positional_embeddings=where, sparse_prompt_embeddings=sparse,
                dense_prompt_embeddings=dense, multimask_output=True, high_resolution_features=features[:-1],
            )  # fmt: skip
            return scores, masks + 0 * given[0].sum()
        sparse, dense = model.prompt_encoder(input_points=points, input_labels=labels, input_boxes=None,
                                             input_masks=None)  # fmt: skip
        masks, scores = model.mask_decoder(
            image_embeddings=given[0], image_positional_embeddings=given[1], sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense, multimask_output=True,
        )[:2]  # fmt: skip
        return scores, masks


def write_masks_export(folder: Path, kind: str = "sam", precision: str = "fp32") -> Path:
    """A folder with the export of a tiny SAM or SAM 2 of random weights."""
    (folder / "onnx").mkdir(parents=True)
    model, names = getattr(tiny_models, kind)(), FEATURES[kind]
    image = torch.zeros((1, 3, SIDE, SIDE))
    points, labels = torch.zeros((1, 5, 1, 2)), torch.ones((1, 5, 1), dtype=torch.int64)
    with torch.no_grad():
        features = Encoder(model)(image)
    boxes = {"input_boxes": torch.zeros((1, 0, 4))} if kind == "sam2" else {}
    given = {"input_points": points, "input_labels": labels, **boxes, **dict(zip(names, features, strict=True))}
    per_point = {0: "batch_size", 1: "point_batch_size"}
    axes = {"input_points": {**per_point, 2: "nb_points"}, "input_labels": {**per_point, 2: "nb_points"},
            "input_boxes": {0: "batch_size", 1: "boxes"}, "iou_scores": per_point, "pred_masks": per_point}  # fmt: skip
    parts = (
        ("vision_encoder", Encoder(model), {"pixel_values": image}, names),
        ("prompt_encoder_mask_decoder", Decoder(model), given, ["iou_scores", "pred_masks"]),
    )
    for name, network, fed, outputs in parts:
        path = folder / "onnx" / f"{name}.onnx"
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            torch.onnx.export(
                network.eval(), tuple(fed.values()), str(path), input_names=list(fed), output_names=outputs,
                opset_version=17, dynamic_axes={own: axes.get(own, {0: "batch_size"}) for own in (*fed, *outputs)},
                dynamo=False,
            )  # fmt: skip
        ready_made.convert(path, precision)
    square = {"height": SIDE, "width": SIDE}
    size = {"size": square} if kind == "sam2" else {"size": {"longest_edge": SIDE}, "pad_size": square}
    means = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
    (folder / "preprocessor_config.json").write_text(json.dumps({**means, **size, "do_resize": True}))
    (folder / "README.md").write_text("---\nlicense: apache-2.0\n---\n")
    return folder
