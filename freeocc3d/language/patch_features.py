"""Turns frames into images for a ViT, and its patches back into the frame: resizing, windows, joining."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import ConfigError
from ..core.memory import available_memory
from .model_packages import Package

_BATCH_PATCHES = 4096
"""Number of windows to encode at once, so that memory does not grow with the frame."""


def _check_size(rows: int, columns: int, h: int, w: int, package: Package) -> None:
    """Raises ConfigError if the frame's image, its features, or the attention of a window do not fit into memory."""
    image, features = rows * columns * package.patch**2 * 12, rows * columns * package.dimension * 8
    if (needed := image + features + 8 * (h * w) ** 2) > (free := available_memory()):
        raise ConfigError(
            f"'short_side' and 'window' make windows of {h} x {w} patches, whose attention needs about "
            f"{needed / 1e9:.1f} GB of memory; {free / 1e9:.1f} GB are free: choose smaller ones."
        )


@dataclass(frozen=True)
class Tiling:
    """A frame as (rows, columns) patches, and the windows of (h, w) patches that cover them.

    patch: edge of a patch in pixels.  tops, lefts: first patch row and column of the windows.
    """

    grid: tuple[int, int]
    window: tuple[int, int]
    tops: tuple[int, ...]
    lefts: tuple[int, ...]
    patch: int

    @classmethod
    def of(
        cls, height: int, width: int, package: Package, short_side: int, window: int, half_overlap: bool = False
    ) -> Tiling:
        """The tiling of a frame resized to ``short_side`` pixels. Windows have up to ``window`` pixels (0 = the whole
        frame), and overlap by half, or else as little as covers the frame."""
        scale = short_side / min(height, width)
        rows, columns = (max(1, round(size * scale / package.patch)) for size in (height, width))
        most = max(1, window // package.patch) if window else max(rows, columns)
        h, w = min(most, rows), min(most, columns)
        _check_size(rows, columns, h, w, package)
        tops, lefts = (
            _starts(length, own, own // 2 if half_overlap else own) for length, own in ((rows, h), (columns, w))
        )
        return cls((rows, columns), (h, w), tops, lefts, package.patch)

    def image(self, rgb: NDArray[np.uint8], mean: tuple[float, ...], std: tuple[float, ...]) -> NDArray[np.float32]:
        """(3, rows patch, columns patch) the frame, resized and normalized for the network."""
        rows, columns = self.grid
        return resize_image(rgb, (columns * self.patch, rows * self.patch), mean, std)

    def windows(self, image: NDArray[np.float32]) -> Iterator[tuple[NDArray[np.float32], list[tuple[int, int]]]]:
        """Batches (B, 3, h patch, w patch) of windows of an image, with their first patch rows and columns."""
        corners = [(top, left) for top in self.tops for left in self.lefts]
        (h, w), patch = self.window, self.patch
        at_once = max(1, _BATCH_PATCHES // (h * w))
        for start in range(0, len(corners), at_once):
            own = corners[start : start + at_once]
            crops = [image[:, t * patch : (t + h) * patch, left * patch : (left + w) * patch] for t, left in own]
            yield np.stack(crops), own


def resize_image(
    rgb: NDArray[np.uint8], size: tuple[int, int], mean: tuple[float, ...], std: tuple[float, ...]
) -> NDArray[np.float32]:
    """(3, height, width) a picture (H, W, 3), resized to (width, height) and normalized for a network."""
    shrinks = size[0] < rgb.shape[1]
    resized = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    normal = (resized.astype(np.float32) / np.float32(255) - np.array(mean, np.float32)) / np.array(std, np.float32)
    return np.ascontiguousarray(normal.transpose(2, 0, 1))


class Splice:
    """Averages the features of overlapping windows."""

    def __init__(self, tiling: Tiling, dimension: int):
        self.tiling = tiling
        self._sum = np.zeros((*tiling.grid, dimension), np.float32)
        self._count = np.zeros(tiling.grid, np.float32)

    def add(self, features: NDArray[np.float32], corners: list[tuple[int, int]]) -> None:
        """Adds (B, h, w, C) features of windows."""
        h, w = self.tiling.window
        for own, (top, left) in zip(features, corners, strict=True):
            self._sum[top : top + h, left : left + w] += own
            self._count[top : top + h, left : left + w] += 1

    def mean(self) -> NDArray[np.float32]:
        """(rows, columns, C)."""
        return self._sum / self._count[..., None]


def encode_windows(
    rgb: NDArray[np.uint8],
    package: Package,
    short_side: int,
    window: int | None,
    encode: Callable[[NDArray[np.float32], Tiling], NDArray[np.float32]],
    half_overlap: bool = False,
) -> NDArray[np.float32]:
    """(rows, columns, D) unit features of the patches of (H, W, 3) pixels, joined from windows.

    window: in pixels; None = the size of the model's training images.  encode: turns (B, 3, h patch, w patch) windows
    of a tiling into their (B, h, w, D) features.
    """
    side = package.input_size if window is None else window
    tiling = Tiling.of(rgb.shape[0], rgb.shape[1], package, short_side, side, half_overlap)
    splice = Splice(tiling, package.dimension)
    for images, corners in tiling.windows(tiling.image(rgb, package.mean, package.std)):
        splice.add(normalize_patches(encode(images, tiling)), corners)
    return normalize_patches(splice.mean())


def finish_patches(patches: NDArray[np.float32], rgb: NDArray[np.uint8], stride: int) -> NDArray[np.float16]:
    """Turns unit features (rows, columns, D) of patches into an encoder's result: upsampled along the edges of the
    frame's (H, W, 3) pixels, with one feature every ``stride`` pixels; 0 = unchanged."""
    if stride == 0:
        return patches.astype(np.float16)
    from .guided_upsampling import upsample_features

    return upsample_features(patches, rgb, stride)


def resample_patches(features: NDArray[np.float32], grid: tuple[int, int]) -> NDArray[np.float32]:
    """Resamples (h, w, C) features linearly on the cells of another grid that covers the same area."""
    rows, columns = (_linear(own, wanted) for own, wanted in zip(features.shape[:2], grid, strict=True))
    return np.asarray(np.einsum("ri,cj,ijk->rck", rows, columns, features, optimize=True), np.float32)


def _linear(own: int, wanted: int) -> NDArray[np.float32]:
    """(wanted, own) weights of linear interpolation between cell centers; constant beyond the outermost."""
    at = np.clip((np.arange(wanted) + 0.5) * own / wanted - 0.5, 0, own - 1)
    return np.maximum(1 - np.abs(at[:, None] - np.arange(own)), 0).astype(np.float32)


def normalize_patches(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """(..., D) features of unit length; zeros stay."""
    norms = np.linalg.norm(features, axis=-1, keepdims=True)
    return np.asarray(features / np.where(norms > 0, norms, 1), np.float32)


def _starts(length: int, window: int, step: int) -> tuple[int, ...]:
    """The starts of windows that cover ``length``, evenly spread and at most ``step`` apart."""
    steps = -(-(length - window) // max(1, step))
    return tuple(round(n * (length - window) / max(1, steps)) for n in range(steps + 1))
