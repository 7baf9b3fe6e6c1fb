"""Guided upsampling: the compiled kernel against NumPy, and what it is for: edges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from freeocc3d.capture import open_capture
from freeocc3d.language.guided_upsampling import upsample_features, upsample_features_reference

PATCH, STRIDE = 16, 4


def unit(shape: tuple[int, ...], seed: int) -> NDArray[np.float32]:
    values = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


@pytest.mark.parametrize(
    ("size", "grid", "stride"), [((61, 93), (4, 6), 4), ((32, 48), (7, 3), 1), ((20, 20), (1, 1), 8)]
)
def test_kernel_agrees_with_numpy(size: tuple[int, int], grid: tuple[int, int], stride: int) -> None:
    rgb = np.random.default_rng(1).integers(0, 256, (*size, 3), dtype=np.uint8)
    features = unit((*grid, 9), 2)
    features[0, 0] = 0
    got, expected = upsample_features(features, rgb, stride), upsample_features_reference(features, rgb, stride)
    assert got.shape == (-(-size[0] // stride), -(-size[1] // stride), 9)
    assert np.abs(got - expected).max() < 2e-3


def test_what_is_the_same_everywhere_stays() -> None:
    feature = unit((7,), 0)
    rgb = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    assert np.abs(upsample_features(np.broadcast_to(feature, (3, 4, 7)), rgb, 4) - feature).max() < 1e-3


def test_nothing_known_stays_nothing() -> None:
    rgb = np.zeros((40, 60, 3), np.uint8)
    assert not upsample_features(np.zeros((3, 4, 7), np.float32), rgb, 4).any()


def test_features_follow_the_images_edge() -> None:
    """Two halves, the edge within a patch: every pixel takes its own side's feature."""
    rgb = np.zeros((64, 96, 3), np.uint8)
    rgb[:, 53:] = 200
    left, right = np.eye(2, dtype=np.float32)
    features = np.broadcast_to(left, (4, 6, 2)).copy()
    features[:, 4:] = right
    features[:, 3] = 5 / 16 * left + 11 / 16 * right  # columns 48 to 63
    chosen = upsample_features(features, rgb, 1)[..., 1] > 0.7071
    assert np.array_equal(chosen, np.broadcast_to(np.arange(96) >= 53, (64, 96)))


def assigned(features: NDArray[np.floating], names: NDArray[np.float32]) -> NDArray[np.int64]:
    return (features.astype(np.float32) @ names.T).argmax(axis=-1)


def test_edges_of_the_built_in_room_gain_over_bilinear() -> None:
    """Class images averaged over patches, brought back: pixels near an edge that get their class."""
    capture = open_capture("builtin:room")
    names = unit((len(capture.classes), 32), 3)
    rates = []
    for index in (30, 110, 200):
        frame, labels = capture[index], capture.labels(index)
        assert labels is not None
        height, width = labels.shape
        coarse = names[labels].reshape(height // PATCH, PATCH, width // PATCH, PATCH, 32).mean(axis=(1, 3))
        coarse /= np.linalg.norm(coarse, axis=-1, keepdims=True)
        true = labels[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        edge = (cv2.Laplacian(labels.astype(np.float32), cv2.CV_32F) != 0).astype(np.uint8)
        near = cv2.dilate(edge, np.ones((33, 33)))[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE] > 0
        size = width // STRIDE, height // STRIDE
        bilinear = np.concatenate([cv2.resize(coarse[..., k : k + 4], size) for k in range(0, 32, 4)], axis=-1)
        guided = upsample_features(coarse, frame.color, STRIDE)
        rates.append([(assigned(found, names) == true)[near].mean() for found in (bilinear, guided)])
    wrong_bilinear, wrong_guided = 1 - np.mean(rates, axis=0)
    assert wrong_guided < 0.8 * wrong_bilinear
