"""Layer 4 as a whole: a wall in front of a camera; an empty map."""

import tracemalloc

import numpy as np
import pytest
from scenes import CAMERA, dense, gaussians, lifted, posed, wall_frame

from freeocc3d.core.types import FREE, OCCUPIED, UNKNOWN
from freeocc3d.occupancy import build, carve, splat

V = 0.08
SPHERES = splat.Options(projection="probabilistic")


def build_wall(distance: float, repeats: int = 2, **splatting):
    frames = [wall_frame(distance, i) for i in range(repeats)]
    poses = np.tile(np.eye(4), (repeats, 1, 1))
    g = lifted(frames, poses, 0.5 * V)
    features = np.zeros((len(g), 3), np.float16)
    features[np.arange(len(g)), (g.means[:, 0] > 0).astype(int)] = 1  # left half, right half
    return build.build_occupancy(g, features, posed(frames, poses), splat.Options(**splatting), carve.Options()), g


def test_a_wall_is_one_voxel_thick_free_before_it_and_unknown_behind_it() -> None:
    occupancy, _ = build_wall(25.5 * V)
    column = dense(occupancy, occupancy.state, (0, 0, 0), (1, 1, 32), UNKNOWN)[0, 0]
    assert column[25] == OCCUPIED
    assert (column[4:24] == FREE).all()
    assert (column[26:] == UNKNOWN).all()
    assert np.count_nonzero(occupancy.state == OCCUPIED) == pytest.approx(
        (CAMERA.width / CAMERA.fx) * (CAMERA.height / CAMERA.fy) * 25.5**2, rel=0.12
    )


def test_features_and_colors_belong_to_their_voxels() -> None:
    occupancy, g = build_wall(25.5 * V)
    voxels = occupancy.occupied_voxels()
    assert len(voxels) == len(occupancy.features) == len(occupancy.colors)
    x = occupancy.centers(voxels)[:, 0]
    assert (occupancy.features[x < -V].argmax(axis=1) == 0).all()
    assert (occupancy.features[x > V].argmax(axis=1) == 1).all()
    np.testing.assert_allclose(np.linalg.norm(occupancy.features.astype(float), axis=1), 1.0, atol=2e-3)
    for voxel in (0, len(voxels) // 2):
        in_reach = np.linalg.norm(g.means - occupancy.centers(voxels[voxel : voxel + 1]), axis=1) < 1.5 * V
        assert (occupancy.colors[voxel] >= g.colors[in_reach].min(axis=0)).all()
        assert (occupancy.colors[voxel] <= g.colors[in_reach].max(axis=0)).all()


def test_what_several_images_see_through_is_not_occupied() -> None:
    # A Gaussian that floats between the camera and a wall that twelve images show behind it.
    frames = [wall_frame(2.0, i) for i in range(12)]
    poses = np.tile(np.eye(4), (12, 1, 1))
    floater = gaussians([[0.02, 0.02, 1.0]], 0.05)
    nothing = np.zeros((1, 0), np.float16)
    contradicted = build.build_occupancy(floater, nothing, posed(frames, poses), SPHERES, carve.Options())
    assert np.count_nonzero(contradicted.state == OCCUPIED) == 0
    kept = build.build_occupancy(floater, nothing, posed(frames[:2], poses[:2]), SPHERES, carve.Options())
    assert np.count_nonzero(kept.state == OCCUPIED) > 0


def test_an_empty_map_has_no_voxels() -> None:
    none = gaussians(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)))
    occupancy = build.build_occupancy(none, np.zeros((0, 4), np.float16), [], splat.Options(), carve.Options())
    assert occupancy.keys.shape == (0, 3)
    assert occupancy.features.shape == (0, 4)


def test_unknown_features_stay_zero_and_known_ones_become_unit() -> None:
    rows = build.normalize_rows(np.array([[0, 0, 0], [3, 4, 0]], np.float32))
    np.testing.assert_allclose(rows.astype(float), [[0, 0, 0], [0.6, 0.8, 0]], atol=1e-3)


def test_a_hall_of_200_meters_costs_what_is_in_it() -> None:
    """Its dense array would hold 400 million voxels."""
    corners = [(-100.0, -100.0, 0.0), (100.0, 100.0, 5.0), (-100.0, 99.0, 2.0)]
    frames = [wall_frame(2.0, n) for n in range(3)]
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = corners
    g = lifted(frames, poses)
    features = np.ones((len(g), 2), np.float16)
    tracemalloc.start()
    occupancy = build.build_occupancy(g, features, posed(frames, poses), splat.Options(), carve.Options())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
    assert len(occupancy.keys) < 600
    extent = np.ptp(occupancy.centers(occupancy.occupied_voxels()), axis=0)
    assert (extent > (199, 198, 4)).all()
    for low, high in ((-110, -90), (90, 110)):  # the same wall at either end
        x = occupancy.centers(occupancy.occupied_voxels())[:, 0]
        assert np.count_nonzero((x > low) & (x < high)) > 0.15 * len(x)
