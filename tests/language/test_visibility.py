"""Which Gaussians a view sees, and how well: the compiled kernel against NumPy."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA, gaussians, random_gaussians

from freeocc3d.core.types import Frame, Gaussians, Intrinsics
from freeocc3d.language.lifting import Options
from freeocc3d.language.visibility import VisibleGaussians, find_visible, find_visible_reference

FLAT = Options(border=0.0)


def frame(depth_m: object) -> Frame:
    shape = CAMERA.height, CAMERA.width
    depth = np.broadcast_to(np.asarray(depth_m, np.float32), shape).copy()
    return Frame(0, 0.0, np.zeros((*shape, 3), np.uint8), depth, CAMERA)


def pose(seed: int) -> NDArray[np.float64]:
    """A camera about two meters from the origin that looks at it, turned a little."""
    rng = np.random.default_rng(seed)
    U, _, Vt = np.linalg.svd(np.eye(3) + 0.2 * rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag((1, 1, np.linalg.det(U @ Vt))) @ Vt
    T[:3, 3] = T[:3, :3] @ (0.1, -0.2, -2.0)
    return T


def is_seen(z: float, depth_m: object, scale: float = 0.01, options: Options = FLAT) -> bool:
    """Whether one Gaussian on the optical axis is seen in a depth image."""
    return len(find_visible(gaussians((0.0, 0.0, z), scale), frame(depth_m), np.eye(4), options).rows) == 1


def weight(z: float, depth_m: object, options: Options | None = None, x: float = 0.0) -> float:
    found = find_visible(
        gaussians((x, 0.0, z), 0.01), frame(depth_m), np.eye(4), options or Options(visible_within=10.0, border=0.0)
    )
    return float(found.weights[0])


UNEVEN = Intrinsics(160, 120, 130.0, 110.0, 83.25, 55.75)
"""A camera whose axes differ."""


def settled(cloud: Gaussians, image: Frame, T: NDArray[np.float64], options: Options) -> NDArray[np.bool_]:
    """Whether a Gaussian is seen, at the same pixel, also by a camera and a tolerance that differ a little: float32
    puts those that are not on the other side of a border now and then."""
    pixels, weights = find_visible_reference(cloud, image, T, options)
    same = np.ones(len(cloud), bool)
    camera = image.intrinsics
    for x, y, more in ((2e-3, 2e-3, 0), (-2e-3, 2e-3, 0), (2e-3, -2e-3, 0), (-2e-3, -2e-3, 0), (0, 0, 1), (0, 0, -1)):
        moved = replace(image, intrinsics=replace(camera, cx=camera.cx + x, cy=camera.cy + y))
        wider = msgspec.structs.replace(options, visible_within=options.visible_within + 1e-4 * more)
        others, other_weights = find_visible_reference(cloud, moved, T, wider)
        same &= ((other_weights > 0) == (weights > 0)) & ((others == pixels) | (weights == 0))
    return same


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("measured", [0.0, 0.6, 1.0])
def test_kernel_agrees_with_numpy(seed: int, measured: float) -> None:
    rng = np.random.default_rng(seed)
    cloud = random_gaussians(3000, seed, extent=3.0)
    depth = 2.0 + rng.normal(0, 0.3, (CAMERA.height, CAMERA.width))
    depth[rng.random(depth.shape) >= measured] = 0
    image, T = replace(frame(depth), intrinsics=UNEVEN), pose(seed)
    options = Options(visible_within=0.1, visible_share=0.05, border=0.2)
    found = find_visible(cloud, image, T, options)
    pixels, weights = find_visible_reference(cloud, image, T, options)
    ours = np.zeros(len(cloud))
    ours[found.rows] = found.weights
    same = settled(cloud, image, T, options)
    assert same.mean() > 0.97
    assert 80 < np.count_nonzero(weights) < 2500
    np.testing.assert_allclose(ours[same], weights[same], rtol=2e-3, atol=1e-6)
    kept = same[found.rows]
    np.testing.assert_array_equal(found.pixels[kept], pixels[found.rows][kept])


def test_hidden_and_outside_are_not_seen() -> None:
    assert is_seen(2.0, 2.0)
    assert not is_seen(2.0, 1.5)  # behind what the image shows
    assert not is_seen(2.0, 2.5)  # before it: what the image shows was seen through the Gaussian
    assert not is_seen(-2.0, 2.0)


def test_where_nothing_is_measured_the_rendered_depth_decides() -> None:
    cloud = gaussians([(0.0, 0.0, 2.0), (0.0, 0.0, 3.0), (0.5, 0.0, 3.0)], 0.02)
    np.testing.assert_array_equal(find_visible(cloud, frame(0.0), np.eye(4), FLAT).rows, [0, 2])
    # a measured depth is not overruled: what it shows through a Gaussian is seen
    np.testing.assert_array_equal(find_visible(cloud, frame(3.0), np.eye(4), FLAT).rows, [1, 2])


def test_tolerance_grows_with_depth_and_with_the_gaussian() -> None:
    assert is_seen(1.0, 1.025, 0.001)
    assert not is_seen(1.0, 1.045, 0.001)
    assert is_seen(4.0, 4.045, 0.001)
    assert is_seen(1.0, 1.045, 0.02)


def test_a_gaussians_extent_counts_along_the_ray_alone() -> None:
    flat = (0.5, 0.5, 0.001)
    for quat, expected in (((1, 0, 0, 0), False), ((np.sqrt(0.5), 0, np.sqrt(0.5), 0), True)):
        cloud = gaussians((0.0, 0.0, 2.0), flat, quats=quat)
        assert bool(len(find_visible(cloud, frame(2.2), np.eye(4), FLAT).rows)) == expected


def test_near_views_count_more() -> None:
    assert weight(1.0, 1.0) / weight(2.0, 2.0) == pytest.approx(4, rel=1e-3)
    assert weight(0.2, 0.2) == pytest.approx(weight(0.5, 0.5), rel=1e-3)


def test_views_along_the_surface_count_less() -> None:
    """A plane z = 2 + x tan(60°) is seen at 60° to its normal on the optical axis."""
    slope = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    tilted = 2.0 / (1.0 - slope * np.tan(np.deg2rad(60)))
    assert weight(2.0, tilted[None]) / weight(2.0, 2.0) == pytest.approx(0.5, rel=0.05)


def test_the_image_edge_counts_less_and_the_middle_in_full() -> None:
    half = 2.0 * (CAMERA.width / 2 - 0.6) / CAMERA.fx  # the last column, at 2 m
    plain, bordered = Options(border=0.0), Options(border=0.2)
    assert weight(2.0, 2.0, bordered) == pytest.approx(weight(2.0, 2.0, plain))
    assert weight(2.0, 2.0, bordered, x=half) / weight(2.0, 2.0, plain, x=half) == pytest.approx(0.25, rel=0.1)


def test_cells_are_those_that_the_pixels_lie_in() -> None:
    """Pixel borders and cell borders, for images whose size is no multiple of the features'."""
    row, column = (axis.reshape(-1) for axis in np.mgrid[0:120:7, 0:160:3])
    pixels = (row * 160 + column).astype(np.int32)
    view = VisibleGaussians(
        np.arange(len(pixels), dtype=np.int32), pixels, np.ones(len(pixels), np.float32), (120, 160)
    )
    np.testing.assert_array_equal(view.cells((7, 9)), row * 7 // 120 * 9 + column * 9 // 160)
