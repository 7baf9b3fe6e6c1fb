"""Free space from depth: a wall, a thin post, missing depth."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, wall_frame

from freeocc3d.core import voxel_keys
from freeocc3d.core.depth_sensors import STRUCTURED_LIGHT
from freeocc3d.core.transforms import project
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.occupancy import carve

V = 0.08
ORIGIN = np.array([-2.0, -2.0, 0.0])
OPTIONS = carve.Options()


def evidence_of(frame: Frame, T=None, options: carve.Options = OPTIONS):
    """Counts of one image over the blocks that it looks into, and the voxel centers in the world."""
    T = np.eye(4) if T is None else T
    evidence = carve.DepthEvidence(ORIGIN, V, options)
    packed = evidence.add(frame, T)
    np.testing.assert_array_equal(packed, evidence.packed)
    local = np.stack((np.arange(512) // 64, np.arange(512) // 8 % 8, np.arange(512) % 8), axis=1)
    centers = ORIGIN + ((voxel_keys.unpack_voxels(packed)[:, None] * 8 + local) + 0.5) * V
    return evidence.free, evidence.hits, centers


def test_a_wall_is_hit_what_lies_before_it_is_free_and_behind_it_nothing_is_known() -> None:
    free, hits, centers = evidence_of(wall_frame(2.0))
    z = centers[..., 2]
    pixels, _ = project(centers, CAMERA)
    with np.errstate(invalid="ignore"):
        seen = (pixels > 4).all(axis=-1) & (pixels < (CAMERA.width - 5, CAMERA.height - 5)).all(axis=-1) & (z > 0.2)
    assert (free[seen & (z < 2.0 - 1.5 * V)] == 1).all()
    assert (free[z > 2.0 - 0.5 * V] == 0).all()
    assert (hits[seen & (np.abs(z - 2.0) < 0.4 * V)] == 1).all()
    assert (hits[np.abs(z - 2.0) > 1.5 * V] == 0).all()
    assert (free[z < 0] == 0).all()


def test_the_camera_may_stand_anywhere() -> None:
    T = np.array([[0, 0, 1, -1.0], [1, 0, 0, 0.2], [0, 1, 0, 1.1], [0, 0, 0, 1.0]])  # looks along world x
    free, hits, centers = evidence_of(wall_frame(2.0), T)
    assert free.sum() > 1000
    assert centers[free > 0][:, 0].max() < 1.0 - 0.5 * V
    assert centers[free > 0][:, 0].min() > -1.0
    assert np.abs(centers[hits > 0][:, 0] - 1.0).max() <= 1.5 * V


def test_a_voxel_with_a_thin_post_in_it_is_not_seen_through_next_to_the_post() -> None:
    frame = wall_frame(3.0)
    post = slice(82, 85)  # 3 pixels at 1.5 m: 3.5 cm, beside the optical axis
    frame.depth_m[:, post] = 1.5
    free, _, centers = evidence_of(frame)
    on_post = (np.abs(centers[..., 2] - 1.5) < 0.5 * V) & (np.abs(centers[..., 1]) < 0.5)
    x = (83.0 - CAMERA.cx) / CAMERA.fx * 1.5
    assert (free[on_post & (np.abs(centers[..., 0] - x) < 0.5 * V)] == 0).all()
    assert (free[on_post & (np.abs(centers[..., 0] - x) > 2 * V) & (np.abs(centers[..., 0]) < 0.6)] == 1).all()


def test_missing_depth_says_nothing() -> None:
    frame = wall_frame(2.0)
    frame.depth_m[:, :80] = 0
    free, hits, centers = evidence_of(frame)
    left = centers[..., 0] < -0.1
    assert free[left].sum() == hits[left].sum() == 0
    empty = Frame(0, 0.0, frame.color, np.zeros_like(frame.depth_m), CAMERA)
    assert len(carve.DepthEvidence(ORIGIN, V, OPTIONS).add(empty, np.eye(4))) == 0


def test_wide_patches_without_depth_may_be_seen_through_up_to_a_distance() -> None:
    frame = wall_frame(2.0)
    frame.depth_m[:, 80:] = 0  # half of what the camera sees is out of range
    frame.depth_m[50:54, 20:24] = 0  # a hole in the wall's image
    options = carve.Options(no_return=4.0)
    free, hits, centers = evidence_of(frame, options=options)
    pixels, z = project(centers, CAMERA)
    with np.errstate(invalid="ignore"):
        inside = (pixels > 4).all(axis=-1) & (pixels < (CAMERA.width - 5, CAMERA.height - 5)).all(axis=-1) & (z > 0.2)
        amid, measured = inside & (pixels[..., 0] > 80 + 8), inside & (pixels[..., 0] < 80)
    assert (free[amid & (z < 4.0 - 2.5 * V)] == 1).all()
    assert (free[z > 4.0 - 0.5 * V] == 0).all()
    assert (free[measured & (z > 2.0 - 0.5 * V)] == 0).all()  # behind the wall, through the hole or not
    assert (hits[np.abs(z - 2.0) > 1.5 * V] == 0).all()  # a missing measurement ends nowhere
    evidence = carve.DepthEvidence(ORIGIN, V, options)
    evidence.add(frame, np.eye(4))
    evidence.remove(frame, np.eye(4))
    assert not evidence.free.any()
    assert not evidence.hits.any()


def test_the_margin_grows_with_the_depths_uncertainty() -> None:
    # 20 cm before a wall at 5.8 m is within three standard deviations of its depth and the margin of a voxel.
    for distance, free_there in ((2.0, 1), (5.8, 0)):
        free, _, centers = evidence_of(wall_frame(distance))
        near_axis = np.abs(centers[..., :2]).max(axis=-1) < 0.2
        before = near_axis & (np.abs(centers[..., 2] - (distance - 0.2)) < 0.04)
        assert before.any()
        assert (free[before] == free_there).all()


def test_a_depth_that_says_how_uncertain_it_is_has_that_margin() -> None:
    frame = wall_frame(2.0)
    for sigma, free_there, hit_there in ((0.01, 1, 0), (0.1, 0, 1)):
        sure = replace(frame, depth_sigma_m=np.full_like(frame.depth_m, sigma))
        free, hits, centers = evidence_of(sure)
        near_axis = np.abs(centers[..., :2]).max(axis=-1) < 0.2
        before = near_axis & (np.abs(centers[..., 2] - 1.8) < 0.04)
        assert before.any()
        assert (free[before] == free_there).all()
        assert (hits[before] == hit_there).all()


@pytest.mark.parametrize("sigma", [None, 0.2])
def test_no_block_is_missed_however_small_blocks_are(sigma: float | None) -> None:
    frame = wall_frame(4.0)
    if sigma is not None:
        frame = replace(frame, depth_sigma_m=np.full_like(frame.depth_m, sigma))
        behind = carve.DepthEvidence(ORIGIN, 0.02, OPTIONS).visible_blocks(frame, np.eye(4))
        assert voxel_keys.unpack_voxels(behind)[:, 2].max() == int((4.0 + 3 * sigma) / 0.16)
    for voxel_size in (0.08, 0.02):
        found = set(carve.DepthEvidence(ORIGIN, voxel_size, OPTIONS).visible_blocks(frame, np.eye(4)).tolist())
        edge = 8 * voxel_size
        keys = np.stack(np.meshgrid(*[np.arange(-8, 8)] * 2, np.arange(1, int(3.8 / edge))), axis=-1).reshape(-1, 3)
        middles = (keys + 0.5) * edge
        pixels, _ = project(middles, CAMERA)
        inside = (pixels > 0).all(axis=1) & (pixels < (CAMERA.width - 1, CAMERA.height - 1)).all(axis=1)
        wanted = voxel_keys.pack_voxels(np.floor((middles[inside] - ORIGIN) / edge).astype(int))
        assert len(wanted) > 50
        assert set(wanted.tolist()) <= found


SKEWED = Intrinsics(90, 60, 70.0, 85.0, 41.0, 33.0)
"""A camera whose axes differ in everything."""


def patchwork(seed: int, sigma: bool) -> Frame:
    """A depth image of many small patches at different depths, some without any, seen by ``SKEWED``."""
    rng = np.random.default_rng(seed)
    depth = np.repeat(np.repeat(rng.uniform(0.5, 2.5, (12, 15)), 5, axis=0), 6, axis=1)
    depth[rng.random(depth.shape) < 0.02] = 0.4
    depth[rng.random(depth.shape) < 0.02] = 0
    depth[20:30, 30:48] = 0
    uncertain = np.float32(rng.uniform(0.001, 0.03, depth.shape)) if sigma else None
    return Frame(0, 0.0, np.zeros((*depth.shape, 3), np.uint8), np.float32(depth), SKEWED, uncertain)


def count_plainly(frame: Frame, T, centers, voxel_size: float, options: carve.Options):
    """Whether an image sees through each voxel, ends in it, and whether no border is too near to tell."""
    camera, depth = frame.intrinsics, frame.depth_m.astype(float)
    height, width = depth.shape
    half, near = 0.5 * voxel_size, 1e-4
    point = (centers - T[:3, 3]) @ T[:3, :3]
    z = point[..., 2]
    ahead = z >= half
    safe = np.where(ahead, z, 1.0)
    u = camera.fx * point[..., 0] / safe + camera.cx
    v = camera.fy * point[..., 1] / safe + camera.cy
    column, row = np.floor(u + 0.5).astype(int), np.floor(v + 0.5).astype(int)

    def depth_at(row, column):
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        found = depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        return np.where(inside, found, 0.0), inside

    here, inside = depth_at(row, column)
    sigma = STRUCTURED_LIGHT.compute_sigma(np.abs(depth)) if frame.depth_sigma_m is None else frame.depth_sigma_m
    spread = 3 * sigma[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].astype(float)
    far = options.margin * voxel_size + spread
    du, dv = (camera.fx * half / safe).astype(int), (camera.fy * half / safe).astype(int)
    looked = ahead & inside & (here != 0)
    free = looked & (np.abs(here) - z > far)
    hit = looked & ~free & (here > 0) & (np.abs(here - z) <= half + spread)
    clear = np.abs(z - half) > near
    for border in (u + 0.5, v + 0.5, camera.fx * half / safe, camera.fy * half / safe):
        clear &= np.abs(border - np.rint(border)) > near
    clear &= (np.abs(np.abs(here) - z - far) > near) & (np.abs(np.abs(here - z) - half - spread) > near)
    for down, right in ((0, -du), (0, du), (-dv, 0), (dv, 0)):
        there, _ = depth_at(row + down, column + right)
        free &= (there <= 0) | (there > z + far)
        clear &= np.abs(there - z - far) > near
    return free, hit, clear


@pytest.mark.parametrize(("seed", "sigma", "no_return"), [(0, False, 0.0), (1, True, 0.0), (2, False, 3.0)])
def test_every_voxel_is_counted_as_the_definition_says(seed: int, sigma: bool, no_return: float) -> None:
    turn = np.array(((0.8, 0.0, 0.6), (0.36, 0.8, -0.48), (-0.48, 0.6, 0.64)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, (0.1, -0.2, 0.3)
    options = carve.Options(no_return=no_return, margin=0.7)
    frame = patchwork(seed, sigma)
    free, hits, centers = evidence_of(frame, T, options)
    if no_return:
        frame.depth_m[21:29, 31:47] = -no_return  # all but the rim of the wide patch
    wanted_free, wanted_hits, clear = count_plainly(frame, T, centers, V, options)
    assert clear.mean() > 0.95
    assert wanted_free.sum() > 300
    assert wanted_hits.sum() > 300
    np.testing.assert_array_equal(free[clear], wanted_free[clear])
    np.testing.assert_array_equal(hits[clear], wanted_hits[clear])


def looks(count: int) -> list[tuple[Frame, np.ndarray]]:
    """Walls from a camera that turns and moves."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for n in range(count):
        c, s = np.cos(0.5 * n), np.sin(0.5 * n)
        poses[n, :3, :3] = ((c, 0, s), (0, 1, 0), (-s, 0, c))
        poses[n, :3, 3] = 0.1 * n, 0, 0
    return [(wall_frame(1.5 + 0.2 * n, n, seed=n), T) for n, T in enumerate(poses)]


def counted(images) -> carve.DepthEvidence:
    evidence = carve.DepthEvidence(ORIGIN, V, OPTIONS)
    for frame, T in images:
        evidence.add(frame, T)
    return evidence


def test_counts_add_up_over_images() -> None:
    evidence = counted(3 * looks(1))
    assert set(np.unique(evidence.free)) == {0, 3}
    assert set(np.unique(evidence.hits)) == {0, 3}


def test_the_order_of_images_does_not_count() -> None:
    images = looks(6)
    forth, back = counted(images), counted(images[::-1])
    for name in ("packed", "free", "hits"):
        np.testing.assert_array_equal(getattr(forth, name), getattr(back, name))


def test_an_image_that_is_taken_out_again_leaves_nothing_behind() -> None:
    images = looks(6)
    evidence, without = counted(images), counted(images[:2] + images[3:])
    touched = evidence.remove(*images[2])
    assert len(touched) < len(evidence.packed)
    free, hits = without.at(evidence.packed)
    np.testing.assert_array_equal(evidence.free, free)
    np.testing.assert_array_equal(evidence.hits, hits)


def test_visible_blocks_hold_every_voxel_that_an_image_says_something_about() -> None:
    for frame, T in looks(4):
        few = carve.DepthEvidence(ORIGIN, V, OPTIONS)
        packed = few.add(frame, T)
        around = (voxel_keys.unpack_voxels(packed)[:, None] + np.indices((3, 3, 3)).reshape(3, -1).T - 1).reshape(-1, 3)
        wide = carve.DepthEvidence(ORIGIN, V, OPTIONS)
        wide._make_room(np.unique(voxel_keys.pack_voxels(around)))
        wide._count(wide.packed, frame, T, 1)
        for narrow, broad in ((few.free, wide.free), (few.hits, wide.hits)):
            assert narrow.sum() >= 0.985 * broad.sum()  # the rest lies in blocks that the image's border grazes


def test_log_odds_are_the_sensor_models_and_noise_widens_it() -> None:
    options = carve.Options()
    free, hits = np.array([[4, 0, 2]], np.uint16), np.array([[0, 3, 1]], np.uint16)
    np.testing.assert_allclose(carve.compute_log_odds(free, hits, options), [[-1.6, 9.6, 2.4]], rtol=1e-5)
    np.testing.assert_allclose(-options.miss, np.log(0.4 / 0.6), atol=0.01)
    thickness = []
    for depth in (1.0, 6.0):
        evidence = carve.DepthEvidence(np.zeros(3), 0.08, options)
        evidence.add(wall_frame(depth), np.eye(4))
        hit = np.argwhere(evidence.hits > 0)
        layers = voxel_keys.unpack_voxels(evidence.packed)[hit[:, 0], 2] * 8 + hit[:, 1] % 8
        thickness.append(len(np.unique(layers)))
    assert thickness[0] == 1
    assert thickness[1] >= 3  # half a voxel either side, plus sigma: 2 mm at 1 m, 7 cm at 6 m, and as much noise
