"""Ready-made exports of SAM and SAM 2 become packages, whose masks are those of the network in PyTorch."""

from __future__ import annotations

import json
from pathlib import Path

import mask_exports
import numpy as np
import onnx
import pytest
import tiny_models
import torch

from freeocc3d.core.errors import ModelError
from freeocc3d.language import mask_networks
from freeocc3d.language.ready_made.export_layout import choose_files
from freeocc3d.language.ready_made.mask_packages import package_of_mask_export


@pytest.mark.parametrize("kind", ["sam", "sam2"])
def test_an_export_equals_its_network(tmp_path: Path, kind: str) -> None:
    folder = mask_exports.write_masks_export(tmp_path / "export", kind)
    sizes = {path.relative_to(folder).as_posix(): path.stat().st_size for path in folder.rglob("*.*")}
    assert choose_files("someone/tiny", sizes, None) == ("fp32", [
        "README.md", "preprocessor_config.json", "onnx/vision_encoder.onnx", "onnx/prompt_encoder_mask_decoder.onnx",
    ])  # fmt: skip
    package = package_of_mask_export(folder, tmp_path / "tiny", "someone/tiny", "fp32")
    assert (package.kind, package.input_size, package.stretched) == ("prompts", 64, kind == "sam2")
    rng = np.random.default_rng(0)
    image = rng.normal(size=(1, 3, 64, 64)).astype(np.float32)
    points = rng.uniform(0, 64, (1, 7, 2)).astype(np.float32)
    (features,) = package.session("image").run(["features"], {"image": image})
    fed = {"features": features, "points": points}
    masks, scores = package.session("masks").run(["masks", "scores"], fed)
    with torch.no_grad():
        expected = getattr(tiny_models, kind)()(
            pixel_values=torch.from_numpy(image), input_points=torch.from_numpy(points[:, :, None]),
            input_labels=torch.ones((1, 7, 1), dtype=torch.int64), multimask_output=True,
        )  # fmt: skip
    assert np.abs(masks - expected.pred_masks.numpy()).max() < 1e-3 * np.abs(masks).max()
    assert np.abs(scores - expected.iou_scores.numpy()).max() < 1e-3


def test_wrong_graphs_and_sizes_are_refused_in_a_sentence(tmp_path: Path) -> None:
    folder = mask_exports.write_masks_export(tmp_path / "export")
    decoder = folder / "onnx" / "prompt_encoder_mask_decoder.onnx"
    model = onnx.load(decoder)
    whole = model.SerializeToString()
    del model.graph.output[0]
    onnx.save(model, decoder)
    with pytest.raises(ModelError, match="the second gives pred_masks, without iou_scores"):
        package_of_mask_export(folder, tmp_path / "tiny", "someone/tiny", "fp32")
    decoder.write_bytes((folder / "onnx" / "vision_encoder.onnx").read_bytes())
    with pytest.raises(ModelError, match="they take pixel_values and pixel_values, which are not an image"):
        package_of_mask_export(folder, tmp_path / "tiny", "someone/tiny", "fp32")
    decoder.write_bytes(whole)
    (folder / "preprocessor_config.json").write_text(json.dumps({"size": {"height": 64, "width": 32}}))
    with pytest.raises(ModelError, match="does not state the side of a square image"):
        package_of_mask_export(folder, tmp_path / "tiny", "someone/tiny", "fp32")
    assert not (tmp_path / "tiny").exists()


def test_a_network_gives_the_masks_of_an_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = mask_exports.write_masks_export(tmp_path / "export")
    package = package_of_mask_export(folder, tmp_path / "tiny", "someone/tiny", "fp32")
    monkeypatch.setattr(mask_networks, "_LEAST_SCORE", -10.0)
    monkeypatch.setattr(mask_networks, "_LEAST_STABILITY", 0.1)
    network = mask_networks.MaskNetwork(package, 6)
    rgb = tiny_models.frame(48, 96).color
    masks, scores = network.find_masks(rgb)
    assert masks.shape[1:] == (16, 32)
    assert 0 < len(masks) == len(scores) <= 18
    painted = network.segment(rgb)
    assert painted.shape == (48, 96)
    assert painted.max() > 0


def test_masks_are_stable_different_and_painted_the_smallest_last() -> None:
    masks = np.zeros((3, 10, 10), bool)
    masks[0, :8], masks[1, :7], masks[2, :2, :2] = True, True, True
    kept = mask_networks.suppress_masks(masks, np.array([0.8, 0.9, 0.7], np.float32))
    assert kept.tolist() == [1, 2]
    painted = mask_networks.paint_masks(masks[kept])
    assert (painted[0, 0], painted[5, 5], painted[8, 8]) == (2, 1, 0)
    none = masks[:0]
    assert not mask_networks.paint_masks(none[mask_networks.suppress_masks(none, np.zeros(0, np.float32))]).any()
    logits = np.where(masks[:2], np.array([5.0, 0.5], np.float32)[:, None, None], -5)
    assert mask_networks.measure_stability(logits).tolist() == [1, 0]
    points = mask_networks.spread_points(30, 60, 4)
    assert points.shape == (8, 2)
    assert points[0].tolist() == [7.5, 7.5]
