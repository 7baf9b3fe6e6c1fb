"""Finds the masks of all things in an image with a network of the SAM family, from a grid of points.

Each point gives three masks: a thing, a part of it, and a part of that part. Masks stay if the network itself expects a
high IoU, and if other thresholds of its logits would give nearly the same mask; of a point's masks that stay, the
largest is taken: things, not their parts. Of masks that are nearly the same, the one with the highest expected IoU
stays. Source: A. Kirillov et al., Segment Anything, ICCV 2023, Sec. 5 and App. B; the thresholds are those of SAM 2 (N.
Ravi et al., SAM 2, ICLR 2025). The paper compares boxes of masks; here masks are compared, and at the network's
resolution, a quarter of its input's.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from . import model_packages
from .patch_features import resize_image

KINDS = ("prompts", "sam")
"""Kinds of packages that give masks of points."""

_LEAST_SCORE, _LEAST_STABILITY = 0.8, 0.95
_OFFSET = 1.0
"""By which the threshold of the logits is moved, up and down, for the stability."""
_SAME = 0.7
"""IoU above which two masks are one."""
_LEAST_PIXELS = 16
"""Of a mask, at the network's resolution: 4 x 4."""
_AT_ONCE = 16
"""Points in a batch: SAM's decoder takes some 15 MB for each."""


class MaskNetwork:
    """A network of a package of ``KINDS``, asked at ``points`` points along the longer side of an image.

    Raises ModelError for a package whose networks cannot be loaded.
    """

    def __init__(self, package: model_packages.Package, points: int, device: str = "cpu"):
        self.package, self.points = package, points
        self._image, self._masks = (package.session(part, device) for part in ("image", "masks"))

    def segment(self, rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
        """(H, W) number of the smallest mask at each pixel of an (H, W, 3) image, from 1; 0 = no mask. Raises
        ModelError if the network fails."""
        masks, scores = self.find_masks(rgb)
        height, width = rgb.shape[:2]
        painted = paint_masks(masks[suppress_masks(masks, scores)])
        return np.asarray(cv2.resize(painted, (width, height), interpolation=cv2.INTER_NEAREST_EXACT), np.int32)

    def find_masks(self, rgb: NDArray[np.uint8]) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """(M, h, w) the masks of an (H, W, 3) image at the network's resolution that are good and stable, and their
        (M,) expected IoUs. Raises ModelError if the network fails."""
        square, (rows, columns) = self._square(rgb)
        (features,) = self._image.run(["features"], {"image": square})
        points = spread_points(rows, columns, self.points)
        found, expected = [], []
        for start in range(0, len(points), _AT_ONCE):
            own = points[None, start : start + _AT_ONCE]
            shapes = {"masks": (1, own.shape[1], 3, None, None), "scores": (1, own.shape[1], 3)}
            fed = {"features": features, "points": own}
            logits, scores = self._masks.run(["masks", "scores"], fed, shapes)
            h, w = (-(-shown * edge // self.package.input_size) for shown, edge in
                    zip((rows, columns), logits.shape[3:], strict=True))  # fmt: skip
            logits, scores = logits.reshape(-1, *logits.shape[3:])[:, :h, :w], scores.ravel()
            good = np.flatnonzero(scores >= _LEAST_SCORE)
            good = good[measure_stability(logits[good]) >= _LEAST_STABILITY]
            size = np.count_nonzero(logits[good] > 0, axis=(1, 2))
            order = np.lexsort((-size, good // 3))
            good = good[order][np.unique(good[order] // 3, return_index=True)[1]]
            found.append(logits[good] > 0)
            expected.append(scores[good])
        return np.concatenate(found), np.concatenate(expected)

    def _square(self, rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """(1, 3, S, S) the network's input, and the (rows, columns) of it that show the image."""
        package, side = self.package, self.package.input_size
        by = side / max(rgb.shape[:2])
        rows, columns = (side if package.stretched else max(1, round(own * by)) for own in rgb.shape[:2])
        square = np.zeros((1, 3, side, side), np.float32)
        square[0, :, :rows, :columns] = resize_image(rgb, (columns, rows), package.mean, package.std)
        return square, (rows, columns)


def spread_points(rows: int, columns: int, count: int) -> NDArray[np.float32]:
    """(P, 2) x and y of a grid over an image, with ``count`` points along its longer side."""
    spacing = max(rows, columns) / count
    xs, ys = ((np.arange(max(1, round(side / spacing))) + 0.5) / max(1, round(side / spacing)) * side
              for side in (columns, rows))  # fmt: skip
    return np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2).astype(np.float32)


def measure_stability(logits: NDArray[np.float32]) -> NDArray[np.float64]:
    """(M,) IoU of the masks of (M, h, w) logits at a higher and at a lower threshold; 0 for a mask with few pixels."""
    small = np.count_nonzero(logits > _OFFSET, axis=(1, 2))
    large = np.count_nonzero(logits > -_OFFSET, axis=(1, 2))
    return np.where(small >= _LEAST_PIXELS, small / np.maximum(large, 1), 0.0)


def suppress_masks(masks: NDArray[np.bool_], scores: NDArray[np.float32]) -> NDArray[np.int64]:
    """Rows of the (M, h, w) masks that are not nearly the same as one with a higher score, best first."""
    flat = masks.reshape(len(masks), masks.shape[1] * masks.shape[2]).astype(np.float32)
    shared, size = flat @ flat.T, flat.sum(axis=1)
    same = shared > _SAME * (size[:, None] + size - shared)
    kept = np.ones(len(masks), bool)
    order = np.argsort(-scores, kind="stable")
    for place, row in enumerate(order):
        if kept[row]:
            rest = order[place + 1 :]
            kept[rest] &= ~same[row, rest]
    return order[kept[order]]


def paint_masks(masks: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(h, w) the number of the smallest of (M, h, w) masks at each pixel, from 1; 0 = none."""
    size = np.count_nonzero(masks, axis=(1, 2))
    painted = np.zeros(masks.shape[1:], np.int32)
    for number, row in enumerate(np.argsort(-size, kind="stable"), start=1):
        painted[masks[row]] = number
    return painted


def load_mask_network(model: str, option: str, points: int, device: str = "cpu") -> MaskNetwork:
    """The network in the folder ``model``, or with that name in the models folder. ``option`` is the key that selected
    it. Raises ModelError."""
    return MaskNetwork(model_packages.find_model(model, KINDS, option), points, device)
