"""Layer 1: given poses, records and submaps, the pose graph, overlap."""

import numpy as np
import pytest
from scenes import wall_frame
from small_captures import data_folder, write_seven_scenes

from freeocc3d.capture import open_capture
from freeocc3d.core.errors import TrackingError
from freeocc3d.core.transforms import invert, project, quats_to_rotations
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.settings import registry
from freeocc3d.tracking import pose_graph
from freeocc3d.tracking.base import Tracker
from freeocc3d.tracking.given_poses import GivenTracker
from freeocc3d.tracking.overlap import (
    DepthView,
    measure_mutual_overlap,
    measure_overlap,
    measure_overlap_reference,
    sample_points,
)
from freeocc3d.tracking.pose_graph import Edge
from freeocc3d.tracking.records import Records


def motion(angle_deg: float, x: float) -> np.ndarray:
    T = np.eye(4)
    half = np.deg2rad(angle_deg) / 2
    T[:3, :3] = quats_to_rotations(np.array([np.cos(half), 0, np.sin(half), 0]))
    T[0, 3] = x
    return T


def test_known_takes_the_captures_poses_and_says_when_there_are_none(tmp_path) -> None:
    known = registry.load("tracking.trackers", "known")
    kitchen = open_capture(data_folder() / "7scenes-kitchen")
    t: Tracker = known.load(known.Options(), kitchen)
    for i in (0, 5, 10):
        t.track(kitchen[i])
    trajectory = t.trajectory(kitchen.timestamps)
    for i in (0, 5, 10):
        np.testing.assert_allclose(trajectory.T_world_cam[i], kitchen.pose(i), atol=2e-4)
    poseless = open_capture(write_seven_scenes(tmp_path / "poseless", 3, poses=False))
    with pytest.raises(TrackingError, match=r"leave tracking\.backend at auto"):
        known.load(known.Options(), poseless)


def test_known_makes_no_keyframe_of_a_frame_without_depth_and_refuses_poses_far_away(monkeypatch) -> None:
    known = registry.load("tracking.trackers", "known")
    kitchen = open_capture(data_folder() / "7scenes-kitchen")
    t = known.load(known.Options(), kitchen)
    for i in range(6):
        frame = kitchen[i]
        depth = np.zeros_like(frame.depth_m) if i in (0, 2, 3) else frame.depth_m
        t.track(Frame(i, float(i), frame.color, depth, frame.intrinsics))
    trajectory = t.trajectory(kitchen.timestamps)
    assert trajectory.keyframes.tolist() == [1]
    assert trajectory.status[:4].tolist() == ["lost", "keyframe", "tracked", "tracked"]
    far = kitchen.pose(0) + [[0, 0, 0, 5e5], [0] * 4, [0] * 4, [0] * 4]
    monkeypatch.setattr(type(kitchen), "pose", lambda self, index: far)
    with pytest.raises(TrackingError, match="common offset"):
        known.load(known.Options(), kitchen).track(kitchen[0])


def test_records_move_frames_with_their_keyframe() -> None:
    records = Records()
    records.add_keyframe(0, np.eye(4), 1.0)
    records.add_tracked(1, 0, motion(5, 0.1), 0.9)
    records.add_lost(2)
    records.T_world_keyframe[0] = motion(30, 1.0)
    trajectory = records.trajectory(np.arange(4.0))
    np.testing.assert_allclose(trajectory.T_world_cam[1], motion(30, 1.0) @ motion(5, 0.1))
    assert trajectory.status.tolist() == ["keyframe", "tracked", "lost", "unused"]
    again = Records.from_arrays(records.to_arrays()).trajectory(np.arange(4.0))
    np.testing.assert_array_equal(again.T_world_cam, trajectory.T_world_cam)


def test_the_pose_graph_spreads_a_loops_error_and_survives_a_wrong_edge() -> None:
    rng = np.random.default_rng(0)
    true = [motion(36 * k, 0.0) @ motion(0, 1.0) for k in range(10)]
    information = np.diag([1e4] * 6)
    edges, drifted = [], [true[0]]
    for k in range(1, 10):
        noise = motion(rng.normal(0, 0.5) + 1.0, rng.normal(0, 0.005))
        T = invert(true[k - 1]) @ true[k] @ noise
        edges.append(Edge(k, k - 1, T, information, uncertain=False))
        drifted.append(drifted[-1] @ T)
    for k in range(9):
        edges.append(Edge(9, k, invert(true[k]) @ true[9], information, uncertain=True))
    wrong = Edge(7, 2, motion(80, 2.0), information, uncertain=True)

    def error(poses) -> float:
        return max(np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(poses, true, strict=True))

    assert error(drifted) > 0.1
    assert error(pose_graph.optimize(drifted, edges)) < 0.4 * error(drifted)
    assert error(pose_graph.optimize(drifted, [*edges, wrong])) < 0.4 * error(drifted)


def test_overlap_falls_when_the_camera_turns_away_and_when_it_steps_back() -> None:
    frame = wall_frame(2.0)
    view = DepthView(frame.depth_m, frame.intrinsics, sample_points(frame.depth_m, frame.intrinsics))
    assert measure_overlap(view.points, np.eye(4), view) == 1.0
    assert measure_overlap(view.points, motion(180, 0), view) == 0.0
    assert 0.3 < measure_overlap(view.points, motion(0, 1.0), view) < 0.7
    behind = wall_frame(3.0)
    far = DepthView(behind.depth_m, behind.intrinsics, sample_points(behind.depth_m, behind.intrinsics))
    T_far_near = np.eye(4)
    T_far_near[2, 3] = 1.0
    assert measure_overlap(view.points, T_far_near, far) == 1.0
    assert measure_mutual_overlap(view, far, T_far_near) < 0.6


def test_records_tell_submaps_and_which_closures_hold() -> None:
    records = Records()
    for index, submap in ((0, 0), (4, 0), (8, 0), (12, 1)):
        records.add_keyframe(index, motion(0, 0.1 * index), 1.0, submap)
        for after in (1, 2, 3):
            records.add_tracked(index + after, len(records.keyframe_index) - 1, motion(0, 0.1 * after), 0.9)
    right = Edge(2, 0, motion(0, 0.8), np.eye(6), uncertain=True)
    wrong = Edge(2, 1, motion(0, 1.9), np.eye(6), uncertain=True)
    along = Edge(1, 0, motion(0, 0.4), np.eye(6), uncertain=False)
    mapped, apart = records.submaps([along, right, wrong])
    assert mapped.frames.tolist() == list(range(12))
    assert mapped.keyframes.tolist() == [0, 4, 8]
    assert mapped.closures.tolist() == [[8, 0], [8, 4]]
    assert mapped.held.tolist() == [True, False]
    assert apart.frames.tolist() == [12, 13, 14, 15]
    np.testing.assert_allclose(apart.T_submap_cam[1], motion(0, 1.2) @ motion(0, 0.1))
    trajectory = records.trajectory(np.arange(16.0))
    assert (trajectory.status[12:] == "apart").all()
    assert trajectory.keyframes.tolist() == [0, 4, 8]
    assert Records().submaps() == []


# Overlap and given poses, at their borders


@pytest.mark.parametrize("step", [8, 16])
def test_sampled_points_lie_on_the_pixels_around_which_a_step_is_centered(step: int) -> None:
    camera = Intrinsics(64, 48, 50.0, 40.0, 31.0, 20.0)
    depth = np.random.default_rng(0).uniform(1, 3, (48, 64)).astype(np.float32)
    depth[step // 2, step // 2] = 0
    points = sample_points(depth, camera, step)
    pixels, z = project(points.astype(float), camera)
    wanted = [(u, v) for v in range(step // 2, 48, step) for u in range(step // 2, 64, step)][1:]
    np.testing.assert_allclose(pixels, wanted, atol=1e-4)
    np.testing.assert_allclose(z, [depth[v, u] for u, v in wanted])


@pytest.mark.parametrize(
    ("pixel", "depth_m", "seen"),
    [
        ((-0.49, 10), 2.0, True),
        ((-0.51, 10), 2.0, False),
        ((39.49, 10), 2.0, True),
        ((39.51, 10), 2.0, False),
        ((10, -0.49), 2.0, True),
        ((10, -0.51), 2.0, False),
        ((10, 29.49), 2.0, True),
        ((10, 29.51), 2.0, False),
        ((10, 10), 2.19, True),
        ((10, 10), 2.21, False),
        ((10, 10), 1.81, True),
        ((10, 10), 1.79, False),
        ((10, 10), 0.0, True),  # a missing depth does not disagree
    ],
)
def test_a_point_is_seen_within_the_image_where_the_depth_agrees_or_is_missing(pixel, depth_m, seen: bool) -> None:
    camera = Intrinsics(40, 30, 30.0, 25.0, 19.0, 14.0)
    u, v = pixel
    point = np.float32([(2 * (u - 19.0) / 30, 2 * (v - 14.0) / 25, 2.0)])
    view = DepthView(np.full((30, 40), depth_m, np.float32), camera, point)
    assert measure_overlap(point, np.eye(4), view) == seen
    both = np.concatenate((point, np.float32([(0.1, 0.1, -2.0), (0.0, 0.0, 0.0)])))  # behind the camera, and in it
    assert measure_overlap(both, np.eye(4), view) == pytest.approx(seen / 3)


def test_of_two_overlaps_the_smaller_counts_whichever_it_is() -> None:
    camera = Intrinsics(40, 30, 30.0, 30.0, 19.5, 14.5)
    near, far = (
        DepthView(depth, camera, sample_points(depth, camera, 2))
        for depth in (np.full((30, 40), 1.0, np.float32), np.full((30, 40), 2.0, np.float32))
    )
    back = np.eye(4)
    back[2, 3] = 1.0  # the near camera in the far one: both see the wall at 2 m
    assert measure_overlap(near.points, back, far) == 1.0
    share = measure_overlap(far.points, invert(back), near)
    assert 0.2 < share < 0.35
    assert measure_mutual_overlap(near, far, back) == measure_mutual_overlap(far, near, invert(back)) == share


def given(poses, overlap: float = 0.8) -> GivenTracker:
    return GivenTracker(np.stack(poses), overlap)


def test_given_poses_make_keyframes_of_frames_that_show_other_things() -> None:
    poses = [motion(angle, 0.0) for angle in (0, 2, 30, 31)]
    poses[1] = poses[1] + 1e-5  # files round poses
    unknown = np.full((4, 4), np.nan)
    t = given([unknown, *poses])
    statuses = [t.track(wall_frame(2.0, index)) for index in range(5)]
    assert [one.status for one in statuses] == ["lost", "keyframe", "tracked", "keyframe", "tracked"]
    assert [one.confidence for one in statuses] == [0, 1, 1, 1, 1]
    trajectory = t.trajectory(np.arange(5.0))
    assert trajectory.keyframes.tolist() == [1, 3]
    np.testing.assert_allclose(trajectory.T_world_cam[1:], poses, atol=3e-5)
    np.testing.assert_allclose(t.poses_ahead()[1:], poses)
    again = given([unknown, *poses])
    frames = [wall_frame(2.0, index) for index in range(5)]
    again.restore(t.state(), frames.__getitem__)
    assert again.track(wall_frame(2.0, 4)).status == "tracked", "the last keyframe is the fourth frame"


@pytest.mark.parametrize(("share", "status"), [(0.049, "lost"), (0.051, "keyframe")])
def test_a_first_frame_needs_some_depth_and_a_later_one_none(share: float, status: str) -> None:
    frame = wall_frame(2.0)
    frame.depth_m.flat[round(share * frame.depth_m.size) :] = 0
    assert given([np.eye(4)]).track(frame).status == status
    t = given([np.eye(4), motion(90, 0.0)])
    t.track(wall_frame(2.0))
    empty = Frame(1, 1.0, frame.color, np.zeros_like(frame.depth_m), frame.intrinsics)
    assert t.track(empty).status == "tracked"


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_given_pose_may_lie_two_kilometers_away_and_no_farther(axis: int) -> None:
    for meters, right in ((1999.0, True), (-1999.0, True), (2001.0, False), (-2001.0, False)):
        T = np.eye(4)
        T[axis, 3] = meters
        if right:
            assert given([T]).track(wall_frame(2.0)).status == "keyframe"
        else:
            with pytest.raises(TrackingError, match="common offset"):
                given([T]).track(wall_frame(2.0))


@pytest.mark.parametrize("lost", [0, 1, 2, 3, 4])
def test_up_to_three_lost_frames_in_a_row_are_interpolated(lost: int) -> None:
    """Frames 0, 2, 4 … of a capture: what was left out is no gap."""
    records = Records()
    records.add_lost(0)
    records.add_keyframe(2, motion(10, 0.5), 0.8)
    for n in range(lost):
        records.add_lost(4 + 2 * n)
    records.add_tracked(4 + 2 * lost, 0, motion(40, 1.0), 0.6)
    records.add_lost(6 + 2 * lost)
    trajectory = records.trajectory(np.arange(20.0))
    filled = 0 < lost <= 3
    inside = [4 + 2 * n for n in range(lost)]
    assert trajectory.status[inside].tolist() == ["interpolated" if filled else "lost"] * lost
    np.testing.assert_allclose(trajectory.confidence[inside], 0.3 if filled else 0.0)
    assert trajectory.status[[0, 6 + 2 * lost]].tolist() == ["lost", "lost"]
    assert trajectory.status[3] == "unused"
    end = motion(10, 0.5) @ motion(40, 1.0)
    for n, row in enumerate(inside if filled else []):
        share = (n + 1) / (lost + 1)
        wanted = motion(10 + 40 * share, 0.0)
        wanted[:3, 3] = (1 - share) * motion(10, 0.5)[:3, 3] + share * end[:3, 3]
        np.testing.assert_allclose(trajectory.T_world_cam[row], wanted, atol=1e-9)


def test_frames_of_another_place_are_no_gap() -> None:
    """Four frames of a second submap between two of the first, which is the larger one."""
    records = Records()
    for index in (0, 1, 2, 3, 4):
        records.add_keyframe(index, motion(0, 0.1 * index), 1.0, submap=0)
    for index in (5, 6, 7, 8):
        records.add_keyframe(index, motion(0, 9.0), 1.0, submap=1)
    records.add_keyframe(9, motion(0, 1.0), 1.0, submap=0)
    trajectory = records.trajectory(np.arange(10.0))
    assert trajectory.status.tolist() == 5 * ["keyframe"] + 4 * ["apart"] + ["keyframe"]
    assert not trajectory.has_pose[5:9].any()
    assert trajectory.keyframes.tolist() == [0, 1, 2, 3, 4, 9]
    assert (trajectory.confidence[5:9] == 0).all()


def test_poses_of_a_chain_stay_for_it_has_no_error_to_spread() -> None:
    poses = [motion(0, 0.5 * k) for k in range(4)]
    edges = [Edge(k, k - 1, motion(1, 0.51), np.diag([1e4] * 6), uncertain=False) for k in range(1, 4)]
    for few, chain in ((poses, edges), (poses[:2], edges[:1] * 3)):
        for found, pose in zip(pose_graph.optimize(list(few), chain), few, strict=True):
            np.testing.assert_array_equal(found, pose)


def test_the_compiled_overlap_is_that_of_numpy() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(1.8, 2.2, (24, 32)).astype(np.float32)
    depth[:6] = 0
    view = DepthView(depth, Intrinsics(32, 24, 20.0, 21.0, 15.3, 11.8), np.zeros((0, 3), np.float32))
    points = rng.uniform((-2, -2, -1), (2, 2, 3), (500, 3)).astype(np.float32)
    for turn in (0.0, 0.4, 2.0):
        T = np.eye(4)
        T[:3, :3] = [(np.cos(turn), 0, np.sin(turn)), (0, 1, 0), (-np.sin(turn), 0, np.cos(turn))]
        T[:3, 3] = (0.1, -0.2, 0.3)
        found = measure_overlap(points, T, view)
        assert found == measure_overlap_reference(points, T, view)
        assert 0 < found < 1
