"""Denoising: the kernel against plain NumPy, noise that averages out, and points off any surface."""

import numpy as np
import pytest
from scenes import CAMERA, lifted, posed, wall_frame, with_sigma
from scipy.spatial.distance import cdist

from freeocc3d.core.transforms import quats_to_rotations
from freeocc3d.core.types import Frame, PosedFrame
from freeocc3d.gaussians import anchors, denoising


def views(count: int, seed: int = 0) -> tuple[list[Frame], np.ndarray]:
    """Depth images of nothing in particular, with holes, from random poses."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    quats = rng.normal(size=(count, 4)) * (0, 0.1, 0.1, 0.1) + (1, 0, 0, 0)
    poses[:, :3, :3] = quats_to_rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    poses[:, :3, 3] = rng.uniform(-0.2, 0.2, (count, 3))
    shape = CAMERA.height, CAMERA.width
    frames = []
    for n in range(count):
        depth = rng.uniform(1.8, 2.2, shape).astype(np.float32)
        depth[rng.uniform(size=shape) < 0.2] = 0
        frames.append(Frame(n, float(n), np.zeros((*shape, 3), np.uint8), depth, CAMERA))
    return frames, poses


@pytest.mark.parametrize("own_sigma", [False, True])
def test_the_kernel_agrees_with_plain_numpy(own_sigma: bool) -> None:
    frames, poses = views(60)
    frames = [with_sigma(frame) for frame in frames] if own_sigma else frames
    points = np.random.default_rng(1).uniform((-1, -1, 1.5), (1, 1, 2.5), (4000, 3))
    points[:, 0] **= 5  # sparse at the sides
    directions = np.random.default_rng(2).normal((0, 0, 0.3), 1, points.shape)  # some were measured from behind
    looks = posed(frames, poses)
    found = denoising.denoise(points, directions, looks, 0.15, 2.1, sample=looks)
    first = [denoising.look_reference(points, directions, look, 0.15, 2.1)[:2] for look in looks]
    registration_m = denoising.estimate_registration(*(sum(part[i].astype(float) for part in first) for i in range(2)))
    assert own_sigma or registration_m > 0.005
    parts = [denoising.look_reference(points, directions, look, 0.15, 2.1, registration_m) for look in looks]
    sums, shown = (sum(part[i].astype(float) for part in parts) for i in range(2))
    through, blank = (sum((part[i] > 0).astype(int) for part in parts) for i in (2, 3))
    past = np.zeros(len(points), int)
    for part in parts:
        past = np.where(part[1], 0, past + (part[2] > 3))
    shown = shown.astype(np.int32)
    assert 800 < np.count_nonzero(shown) < 3900
    assert np.count_nonzero(sums[:, 9]) > 100
    offset, weight = denoising.weigh(sums, shown)
    np.testing.assert_allclose(found.weights, weight, rtol=1e-5)
    np.testing.assert_allclose(found.points, points + offset, atol=1e-6)
    kept = denoising.are_surfaces(shown, through, blank, past)
    fifth = np.sort(cdist(points + offset, (points + offset)[kept]), axis=1)[:, 5]
    alone = (shown < 6) & (blank > shown) & (fifth > 2.5 * np.median(fifth[kept]))
    assert np.count_nonzero(kept & alone) > 0
    np.testing.assert_array_equal(found.kept, kept & ~alone)
    best = np.argmax([part[0][:, 3] for part in parts], axis=0)
    np.testing.assert_array_equal(found.keyframe, np.where(weight > 0, best, -1))


def test_frames_that_see_through_a_point_count_as_much_as_poses_are_wrong() -> None:
    """Five frames see to 3 m, ten show a wall at 2 m; then the frames are a few centimeters off."""
    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(-0.5, 0.5, (200, 2)), np.full(200, 2.0)))
    frames = [wall_frame(3.0, n) for n in range(5)] + [wall_frame(2.0, n) for n in range(5, 15)]
    exact = np.tile(np.eye(4), (15, 1, 1))
    wrong = exact.copy()
    wrong[:, 2, 3] = 0.03 * np.where(np.arange(15) % 2, 1, -1)
    behind = []
    for poses in (exact, wrong):
        found = denoising.denoise(points, points, posed(frames, poses), 0.05, 3.0)
        assert found.kept.all()
        behind.append(float(np.median(found.points[:, 2])) - 2.0)
    assert abs(behind[0]) < 1e-6
    assert 0.02 < behind[1] < 0.07


def test_the_reach_grows_with_what_poses_are_wrong_by() -> None:
    """A camera that drifts to and fro by up to 9 cm, in front of a wall at 2 m."""
    points = np.column_stack((np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2)), np.full(200, 2.0)))
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, 2, 3] = 0.09 * np.sin(np.arange(60))
    looks = posed([wall_frame(2.0, n) for n in range(60)], poses)
    off = {
        len(sample): np.abs(denoising.denoise(points, points, looks, 0.05, 3.0, sample).points[:, 2] - 2.0).max()
        for sample in ([], looks[::2])
    }
    assert off[30] < 0.012 < 0.03 < off[0]


def test_a_noisy_wall_ends_one_layer_thick() -> None:
    frames = [wall_frame(2.02, n, seed=n) for n in range(12)]
    poses = np.tile(np.eye(4), (12, 1, 1))
    thickness, count = {}, {}
    for denoise in (False, True):
        g = lifted(frames, poses, 0.01, denoise=denoise)
        thickness[denoise], count[denoise] = np.std(g.means[:, 2]), len(g)
    assert thickness[True] < 0.4 * thickness[False]
    assert count[True] < 0.7 * count[False]


def test_what_most_images_see_through_is_left_out_and_what_none_shows_stays() -> None:
    frames = [wall_frame(2.0, n) for n in range(3)]
    poses = np.tile(np.eye(4), (3, 1, 1))
    floating, on_the_wall, behind_the_camera, behind_the_wall = (0, 0, 1.0), (0, 0, 2.005), (0, 0, -1.0), (0, 0, 2.5)
    points = np.array([floating, on_the_wall, behind_the_camera, behind_the_wall])
    found = denoising.denoise(points, points, posed(frames, poses), 0.05, 2.0)
    np.testing.assert_array_equal(found.kept, [False, True, True, True])
    np.testing.assert_array_equal(found.weights > 0, [False, True, False, False])
    np.testing.assert_allclose(found.points[1], (0, 0, 2.0), atol=1e-6)
    np.testing.assert_array_equal(found.points[2:], points[2:])


@pytest.mark.parametrize(
    ("shown", "through", "blank", "past", "kept"),
    [
        (1, 0, 3, 0, True),  # few others could have shown it
        (1, 0, 4, 0, False),  # shown once of five times
        (2, 0, 20, 0, True),  # a dark thing, perhaps
        (2, 0, 50, 0, False),
        (6, 0, 500, 0, True),  # something without depth often hides it
        (6, 7, 0, 0, False),
        (20, 9, 0, 4, True),
        (20, 9, 0, 5, False),  # it has left
        (40, 9, 0, 9, True),
        (0, 0, 0, 0, True),
    ],
)
def test_a_point_is_kept_by_what_all_frames_show(shown: int, through: int, blank: int, past: int, kept: bool) -> None:
    counts = (np.array([count], np.int32) for count in (shown, through, blank, past))
    assert denoising.are_surfaces(*counts).tolist() == [kept]


def test_specks_behind_a_pane_and_a_passer_by_are_left_out_and_what_is_behind_a_dark_thing_stays() -> None:
    frames = [wall_frame(2.0, n) for n in range(70)]
    for n, frame in enumerate(frames):
        frame.depth_m[:, :30] = 0  # a pane, with a speck in another place of each third frame
        if n % 3 == 0:
            frame.depth_m[10 + n // 3, 4:8] = 3.0
        if n < 50:
            frame.depth_m[:, -30:] = 1.0  # somebody stands there most of the time, and leaves
        if n >= 8:
            frame.depth_m[30:40, 40:50] = 0  # a dark thing is put before the wall
    g = lifted(frames, np.tile(np.eye(4), (70, 1, 1)), 0.04)
    np.testing.assert_allclose(g.means[:, 2], 2.0, atol=0.02)
    pixels = np.rint(g.means[:, :2] / g.means[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)).astype(int)
    assert ((pixels >= (41, 31)) & (pixels < (49, 39))).all(axis=1).any()
    assert (pixels[:, 0] > CAMERA.width - 25).any()


def test_the_two_sides_of_a_board_stay_apart() -> None:
    front, behind = np.eye(4), np.diag((-1.0, 1.0, -1.0, 1.0))
    behind[2, 3] = 4.04  # looks back at a board of 4 cm, whose other side is 2 m away
    looks = posed([wall_frame(2.0, 0), wall_frame(2.0, 1)], np.stack((front, behind)))
    points = np.array([(0.1, 0.1, 2.003), (0.1, 0.1, 2.037)])
    found = denoising.denoise(points, np.array([(0, 0, 1.0), (0, 0, -1.0)]), looks, 0.05, 2.0)
    np.testing.assert_allclose(found.points[:, 2], (2.0, 2.04), atol=1e-6)


def test_a_frame_between_keyframes_is_anchored_to_the_one_it_hangs_on() -> None:
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 0.3
    cells = anchors.AnchoredCells(anchors.Options(), 0.04, T[:1])
    looks = [PosedFrame(wall_frame(2.0, n), T[n], 0) for n in range(2)]
    for look in looks:
        cells.add(look)
    g = cells.gaussians(looks)
    assert (g.anchor_keyframe == 0).all()
    assert g.means[:, 0].max() > 1.4  # what only the second shows
    np.testing.assert_allclose(g.anchor_cam, g.means, atol=1e-6)


def test_nothing_to_look_at_changes_nothing() -> None:
    points = np.array([(0.0, 0.0, 2.0)])
    found = denoising.denoise(points, points, iter(()), 0.05, 2.0)
    np.testing.assert_array_equal(found.points, points)
    assert found.keyframe[0] == -1


@pytest.mark.parametrize("z", [0.002, 0.02, 2.0])
def test_a_pixel_without_depth_says_nothing_however_near_the_point_is(z: float) -> None:
    frame = wall_frame(2.0)
    frame.depth_m[:] = 0
    points = np.array([(0.0, 0.0, z)])
    found = denoising.denoise(points, points, posed([frame], [np.eye(4)]), 0.15, 6.0)
    assert found.weights.tolist() == [0.0]
    assert found.keyframe.tolist() == [-1]
    np.testing.assert_array_equal(found.points, points)
