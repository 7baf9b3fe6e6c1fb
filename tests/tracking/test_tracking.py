"""Layer 1: given poses, records and submaps, the pose graph, overlap."""

import numpy as np
import pytest
from scenes import wall_frame
from small_captures import data_folder, write_seven_scenes

from freeocc3d.capture import open_capture
from freeocc3d.core.errors import TrackingError
from freeocc3d.core.transforms import invert, quats_to_rotations
from freeocc3d.core.types import Frame
from freeocc3d.settings import registry
from freeocc3d.tracking import pose_graph
from freeocc3d.tracking.base import Tracker
from freeocc3d.tracking.overlap import DepthView, measure_mutual_overlap, measure_overlap, sample_points
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
    with pytest.raises(TrackingError, match=r"tracking\.backend=rgbd"):
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
