"""What a network of patches could tell layer 3: class images averaged over patches of 16 pixels, by the size to which
frames are resized, and by how many keyframes are encoded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .figures import Figures, tabulate
from .fusion_of_mistakes import Scene
from .true_frame import put_keyframes_in_world

SIDES, COVERAGES = (224, 336, 448), (None, 0.98, 0.97, 0.95)
PATCH, BLUR, STRIDE = 16, 0.7, 4
"""Edge of a patch in pixels; how far patches see their neighbors, a standard deviation in patches; pixels between
features."""


def measure_patches(map_path: str) -> Figures:
    """Keyframes, tokens of all of them, and mIoU, for each size and coverage."""
    from freeocc3d.language.feature_fusion import FeatureFusion
    from freeocc3d.language.keyframe_choice import choose_keyframes, measure_detail
    from freeocc3d.language.visibility import find_visible
    from freeocc3d.query.scan_map import load_map

    scan_map = load_map(map_path)
    scene = Scene(scan_map, Path(scan_map.manifest.capture.path) / "ground_truth.npz")
    capture, count = scan_map.capture, len(scene.gaussians)
    frames = list(put_keyframes_in_world(scan_map))
    views = [find_visible(scene.gaussians, frame, T, scene.options) for frame, T, _ in frames]
    sharp = [measure_detail(frame.color) for frame, _, _ in frames]
    chosen = {
        coverage: list(range(len(views)))
        if coverage is None
        else choose_keyframes(views, sharp, count, len(views), coverage)
        for coverage in COVERAGES
    }
    rows = []
    for side in SIDES:
        features = [_average(capture.labels(own.index), len(capture.classes), own.color, side) for own, _, _ in frames]
        for coverage, numbers in chosen.items():
            fusion = FeatureFusion(count, len(capture.classes) - 1, scene.options.disagreement)
            for number in numbers:
                fusion.add(views[number], features[number][1])
            tokens = sum(features[number][0] for number in numbers)
            rows.append([side, coverage, len(numbers), tokens, scene.score(fusion.features())])
    return {"rows": rows}


def _average(labels: Any, classes: int, rgb: Any, side: int) -> tuple[int, Any]:
    """The number of patches, and their features, shares of the classes, upsampled as those of a network."""
    import cv2
    import numpy as np

    from freeocc3d.language.patch_features import finish_patches, normalize_patches

    height, width = labels.shape
    rows, columns = (round(size * side / min(height, width) / PATCH) for size in (height, width))
    shares = [
        cv2.GaussianBlur(
            cv2.resize((labels == k).astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA), (0, 0), BLUR
        )
        for k in range(1, classes)
    ]
    return rows * columns, finish_patches(normalize_patches(np.stack(shares, axis=-1)), rgb, STRIDE)


def tabulate_patches(measured: list[Figures]) -> list[str]:
    """A table of mIoU, a row for each capture, size and coverage."""
    rows = []
    for found in measured:
        if "error" in found:
            rows.append([found["capture"], f"not available, {found['error']}", "–", "–", "–", "–"])
            continue
        for side, coverage, keyframes, tokens, miou in found["rows"]:
            share = "all" if coverage is None else f"{100 * coverage:g} %"
            rows.append([found["capture"], f"{side}", share, f"{keyframes}", f"{tokens}", f"{100 * miou:.1f}"])
    return tabulate(["capture", "short side", "of the surface", "keyframes", "tokens", "mIoU"], rows)
