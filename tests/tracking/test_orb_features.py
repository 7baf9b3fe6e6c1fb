"""ORB features: points on planes, matches, poses, and what a match adds, all computed by hand as well."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.tracking.rgbd import orb_features
from freeocc3d.tracking.rgbd.alignment_views import AlignmentView
from freeocc3d.tracking.rgbd.orb_features import OrbFeatures

COLOR = Intrinsics(160, 120, 150.0, 140.0, 83.0, 57.0)
DEPTH = Intrinsics(80, 60, 70.0, 65.0, 41.0, 28.0)


def slanting(normal: NDArray[np.float64], distance: float) -> AlignmentView:
    """A view of a plane: n x = distance at every pixel of ``DEPTH``."""
    v, u = np.mgrid[: DEPTH.height, : DEPTH.width]
    rays = np.stack(((u - DEPTH.cx) / DEPTH.fx, (v - DEPTH.cy) / DEPTH.fy, np.ones(u.shape)), axis=-1)
    points = rays * (distance / (rays @ normal))[..., None]
    normals = np.broadcast_to(normal, points.shape)
    return AlignmentView(DEPTH, np.float32(points), np.float32(normals), np.float32(points[..., 2]), ())


def tilted(degrees: float) -> NDArray[np.float64]:
    return Rotation.from_euler("yx", (degrees, 0.6 * degrees), degrees=True).apply((0.0, 0.0, 1.0))


def test_rays_are_those_of_the_color_camera() -> None:
    features = OrbFeatures(np.float32([(83, 57), (98, 57), (83, 43)]), np.zeros((3, 32), np.uint8))
    np.testing.assert_allclose(features.rays(COLOR), [(0, 0), (0.1, 0), (0, -0.1)], atol=1e-6)


def test_rays_are_lifted_to_where_they_meet_the_plane() -> None:
    normal = tilted(25)
    view = slanting(normal, 2.0)
    rng = np.random.default_rng(0)
    pixels = rng.uniform((-0.45, -0.45), (79.45, 59.45), (300, 2))
    rays = np.float32((pixels - (DEPTH.cx, DEPTH.cy)) / (DEPTH.fx, DEPTH.fy))
    found = orb_features.lift_rays(rays, view)
    np.testing.assert_allclose(found @ normal, 2.0, rtol=1e-4)
    np.testing.assert_allclose(found[:, :2] / found[:, 2:], rays, atol=1e-5)


@pytest.mark.parametrize("pixel", [(-0.6, 30), (79.6, 30), (30, -0.6), (30, 59.6), (-200, 30), (30, 900)])
def test_rays_beside_the_view_meet_nothing(pixel: tuple[float, float]) -> None:
    rays = np.float32((np.array([pixel]) - (DEPTH.cx, DEPTH.cy)) / (DEPTH.fx, DEPTH.fy))
    np.testing.assert_array_equal(orb_features.lift_rays(rays, slanting(tilted(25), 2.0)), [(0, 0, 0)])


@pytest.mark.parametrize(("off", "known"), [(0.04, True), (0.06, False), (-0.04, True), (-0.06, False)])
def test_a_plane_must_meet_the_ray_near_its_own_pixel(off: float, known: bool) -> None:
    """The plane of a pixel meets a ray beside the pixel's center at another depth, by this share."""
    view, x = slanting(np.array((0.0, 0.0, 1.0)), 2.0), 0.4 / DEPTH.fx
    normal = np.array(((1 / (1 + off) - 1) / x, 0.0, 1.0))
    view.normals[28, 41] = normal / np.linalg.norm(normal)
    found = orb_features.lift_rays(np.float32([(x, 0.0)]), view)[0]
    np.testing.assert_allclose(found[2], 2.0 * (1 + off) if known else 0.0, rtol=1e-4)


def test_missing_surfaces_and_rays_along_them_meet_nothing() -> None:
    view = slanting(np.array((0.0, 0.0, 1.0)), 2.0)
    view.points[28, 41] = 0
    view.normals[28, 42] = (1.0, 0.0, -1.0 / DEPTH.fx)  # across the ray through the pixel
    rays = np.float32([(0, 0), (1 / DEPTH.fx, 0), (2 / DEPTH.fx, 0)])
    assert orb_features.lift_rays(rays, view)[:, 2].tolist() == [0.0, 0.0, 2.0]


def flipped(descriptor: NDArray[np.uint8], count: int) -> NDArray[np.uint8]:
    """The descriptor with so many bits changed."""
    bits = np.unpackbits(descriptor)
    bits[:count] ^= 1
    return np.packbits(bits)


@pytest.mark.parametrize(("bits", "matched"), [(0, True), (63, True), (64, False)])
def test_descriptors_match_if_they_differ_in_less_than_a_quarter_of_their_bits(bits: int, matched: bool) -> None:
    a = np.random.default_rng(0).integers(0, 256, (3, 32), dtype=np.uint8)
    b = np.stack((a[2], flipped(a[0], bits)))
    found = orb_features.match_binary(
        OrbFeatures(np.zeros((3, 2), np.float32), a), OrbFeatures(np.zeros((2, 2), np.float32), b)
    )
    assert sorted(map(tuple, found.tolist())) == ([(0, 1), (2, 0)] if matched else [(2, 0)])


def test_matches_whose_place_is_roughly_known_are_each_others_nearest_around_it() -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 256, (count, 32), dtype=np.uint8) for count in (60, 50))
    b[:40] = [flipped(descriptor, n % 70) for n, descriptor in enumerate(a[:40])]
    rays_a, rays_b = (np.float32(rng.uniform(-0.2, 0.2, (len(x), 2))) for x in (a, b))
    rays_b[:30] = rays_a[:30] + rng.uniform(-0.07, 0.07, (30, 2))
    different = np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2)
    different = np.where(np.abs(rays_a[:, None] - rays_b[None]).max(axis=2) <= 0.06, different, 999)
    nearest = different.argmin(axis=1)
    wanted = [(i, j) for i, j in enumerate(nearest) if different[i, j] < 64 and different[:, j].argmin() == i]
    features = [OrbFeatures(np.zeros((len(x), 2), np.float32), x) for x in (a, b)]
    found = orb_features.match_near(features[0], rays_a, features[1], rays_b, 0.06)
    assert sorted(map(tuple, found.tolist())) == wanted
    assert 10 < len(wanted) < 30
    for n, m in ((0, 50), (60, 0)):
        none = [OrbFeatures(f.pixels[:k], f.descriptors[:k]) for f, k in zip(features, (n, m), strict=True)]
        assert orb_features.match_near(none[0], rays_a[:n], none[1], rays_b[:m], 0.06).shape == (0, 2)


def test_corners_are_found_where_they_are_and_as_many_as_asked_for() -> None:
    color = np.zeros((120, 160, 3), np.uint8)
    for x, y in ((40, 40), (120, 40), (40, 80), (120, 80)):
        color[y : y + 12, x : x + 12] = 200
    frame = Frame(0, 0.0, color, np.ones((120, 160), np.float32), COLOR)
    found = orb_features.detect_features(frame, 40)
    assert 4 <= len(found.pixels) <= 40
    assert found.descriptors.shape == (len(found.pixels), 32)
    corners = np.array([(x + i, y + j) for x in (40, 120) for y in (40, 80) for i in (0, 11) for j in (0, 11)])
    off = np.linalg.norm(found.pixels[:, None] - corners, axis=2).min(axis=1)
    assert np.median(off) < 2
    few = orb_features.detect_features(frame, 5)
    assert len(few.pixels) <= 5


def seen(count: int, seed: int = 0) -> tuple[NDArray, NDArray, NDArray]:
    """Points, a pose, and the rays at which it sees the points."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-1, -1, 2), (1, 1, 4), (count, 3))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec((0.1, -0.2, 0.15)).as_matrix(), (0.2, -0.1, 0.3)
    moved = points @ T[:3, :3].T + T[:3, 3]
    return points, T, moved[:, :2] / moved[:, 2:]


@pytest.mark.parametrize("right", [11, 12, 30])
def test_a_pose_needs_twelve_matches_that_agree(right: int) -> None:
    points, T, rays = seen(right)
    found = orb_features.estimate_pose(np.float32(points), np.float32(rays), 1 / 500)
    assert (found is not None) == (right >= 12)
    if found is not None:
        np.testing.assert_allclose(found[0], T, atol=1e-4)
        assert found[1].tolist() == list(range(right))


@pytest.mark.parametrize(("threshold_px", "kept"), [(3.0, 20), (8.0, 24)])
def test_matches_farther_off_than_the_threshold_are_left_out(threshold_px: float, kept: int) -> None:
    points, T, rays = seen(28)
    rays[20:24] += 5 / 500 / np.sqrt(2)
    rays[24:] += 0.3
    found = orb_features.estimate_pose(np.float32(points), np.float32(rays), 1 / 500, threshold_px, 2000)
    assert found is not None
    assert found[1].tolist() == list(range(kept))
    np.testing.assert_allclose(found[0], T, atol=0.01)


@pytest.mark.parametrize(
    ("off_px", "agree", "weight"), [(0.0, 1, 1.0), (3.0, 1, 0.25), (3.9, 1, 0.1383), (4.1, 0, 0.1216), (12.1, 0, 0.0)]
)
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, -1.0), (0.6, 0.8)])
def test_a_match_weighs_less_the_farther_it_is_off(off_px, agree, weight, direction) -> None:
    point, focal = np.float32([(0.3, -0.2, 2.0)]), 400.0
    ray = point[:, :2] / point[:, 2:] - np.array(direction) * off_px / focal
    H, g = np.zeros((6, 6)), np.zeros(6)
    found = orb_features.add_reprojection(point, np.float32(ray), np.eye(4), focal, H, g)
    assert found == (1, agree)
    x, y, z = point[0].astype(float)
    by_point = focal * np.array(((1 / z, 0, -x / z**2), (0, 1 / z, -y / z**2)))
    turn = np.array(((0, z, -y), (-z, 0, x), (y, -x, 0)))  # of a point by a small rotation: w x p
    J = by_point @ np.concatenate((turn, np.eye(3)), axis=1)
    np.testing.assert_allclose(H, weight * J.T @ J, rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(g, weight * J.T @ (np.array(direction) * off_px), rtol=2e-3, atol=1e-2)


def test_points_without_depth_or_too_near_add_nothing() -> None:
    points = np.float32([(0, 0, 0), (0, 0, 0.09), (0, 0, 0.11)])
    H, g = np.zeros((6, 6)), np.zeros(6)
    assert orb_features.add_reprojection(points, np.zeros((3, 2), np.float32), np.eye(4), 400.0, H, g) == (2, 1)
    assert H[3, 3] == pytest.approx((400 / 0.11) ** 2, rel=1e-5)


@pytest.mark.parametrize(("few", "many"), [(1, 40), (150, 130)])
def test_matches_are_those_of_opencv(few: int, many: int) -> None:
    """Descriptors of few bits that differ, so that many distances are equal."""
    rng = np.random.default_rng(0)
    base = rng.integers(0, 256, (60, 32), np.uint8)
    flips = [np.packbits(rng.random((n, 256)) < 0.06, axis=1) for n in (few, many)]
    a, b = (
        orb_features.OrbFeatures(np.zeros((len(flip), 2), np.float32), base[rng.integers(0, 60, len(flip))] ^ flip)
        for flip in flips
    )
    found = orb_features.match_binary(a, b)
    asked = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(a.descriptors, b.descriptors)
    expected = [(m.queryIdx, m.trainIdx) for m in asked if m.distance < 64]
    assert sorted(map(tuple, found.tolist())) == sorted(expected)
    assert len(found)
