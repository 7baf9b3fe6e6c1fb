"""Layer 1: the odometry on a real scan, loss that is told, records, the pose graph, resuming."""

import numpy as np
import pytest
from helpers import data_folder, write_seven_scenes
from scenes import wall_frame

from freeocc3d import registry
from freeocc3d.capture import open_capture
from freeocc3d.errors import TrackingError
from freeocc3d.geometry import invert, quats_to_rotations
from freeocc3d.tracking import pose_graph, rgbd
from freeocc3d.tracking.base import Tracker
from freeocc3d.tracking.overlap import DepthView, mutual_overlap, overlap, sample_points
from freeocc3d.tracking.pose_graph import Edge
from freeocc3d.tracking.records import Records
from freeocc3d.types import Frame, Intrinsics


def tracker(**options) -> rgbd.RgbdTracker:
    return rgbd.load(rgbd.Options(**options), None)  # type: ignore[arg-type]


def motion(angle_deg: float, x: float) -> np.ndarray:
    T = np.eye(4)
    half = np.deg2rad(angle_deg) / 2
    T[:3, :3] = quats_to_rotations(np.array([np.cos(half), 0, np.sin(half), 0]))
    T[0, 3] = x
    return T


@pytest.mark.parametrize(
    ("capture", "step", "centimetres", "degrees"),
    # The kitchen's colour and depth are only roughly registered, and its own poses uncertain by a centimetre.
    [("7scenes-kitchen", 3, 10.0, 3.0), ("house/bedroom", 2, 2.0, 0.7)],
)
def test_a_scan_is_followed_without_its_poses(capture, step, centimetres, degrees) -> None:
    scan = open_capture(data_folder() / capture)
    indices = range(0, 30 * step, step)
    t = tracker()
    statuses = [t.track(scan[i]).status for i in indices]
    t.optimize()
    trajectory = t.trajectory(scan.timestamps)
    assert "lost" not in statuses
    assert statuses[0] == "keyframe"
    assert statuses.count("keyframe") >= 2
    assert trajectory.has_pose.sum() == len(indices)
    first = np.linalg.inv(scan.pose(0))
    for i in indices:
        error = invert(first @ scan.pose(i)) @ trajectory.T_world_cam[i]
        assert 100 * np.linalg.norm(error[:3, 3]) < centimetres
        assert np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))) < degrees


def test_frames_that_show_nothing_are_lost_and_tracking_goes_on_after_them() -> None:
    kitchen = open_capture(data_folder() / "7scenes-kitchen")
    t = tracker()
    frames = [kitchen[i] for i in range(6)]
    empty = Frame(2, 2.0, frames[2].color, np.zeros_like(frames[2].depth_m), frames[2].intrinsics)
    frames[2] = empty
    statuses = [t.track(frame).status for frame in frames]
    assert statuses[2] == "lost"
    assert "lost" not in statuses[:2] + statuses[3:]
    trajectory = t.trajectory(kitchen.timestamps)
    assert np.isnan(trajectory.T_world_cam[2]).all()
    assert trajectory.status[2] == "lost"
    assert trajectory.status[6] == "unused"


def test_a_jump_to_another_place_is_loss_not_a_pose() -> None:
    kitchen = open_capture(data_folder() / "7scenes-kitchen")
    t = tracker()
    t.track(kitchen[0])
    elsewhere = t.track(kitchen[500])
    assert elsewhere.status == "lost"
    assert elsewhere.T_world_cam is None


def test_the_first_usable_frame_starts_the_map() -> None:
    t = tracker()
    wall = wall_frame(2.0)
    empty = Frame(0, 0.0, wall.color, np.zeros_like(wall.depth_m), wall.intrinsics)
    assert t.track(empty).status == "lost"
    assert t.track(wall_frame(2.0, 1)).status == "keyframe"
    assert t.trajectory(np.arange(3.0)).keyframes.tolist() == [1]


def test_each_part_of_the_failure_test_can_fail() -> None:
    kitchen = open_capture(data_folder() / "7scenes-kitchen")
    good = tracker()
    good.track(kitchen[0])
    assert good.track(kitchen[1]).status == "tracked"
    for strict in ({"min_fitness": 0.999}, {"max_residual": 1e-6}, {"min_information": 1e3}):
        t = tracker(**strict)
        t.track(kitchen[0])
        assert t.track(kitchen[1]).status == "lost", strict


def test_a_point_source_of_structure_is_not_enough() -> None:
    # Depth in a patch of a few pixels: its points lie so close together that rotations are hardly constrained.
    t = tracker()
    frames = [wall_frame(2.0, i) for i in range(2)]
    patches = []
    for frame in frames:
        depth = np.zeros_like(frame.depth_m)
        depth[40:77, 60:92] = 2.0
        patches.append(Frame(frame.index, frame.timestamp, frame.color, depth, frame.intrinsics))
    strict = tracker(min_information=0.05)
    for one, status in ((t, "tracked"), (strict, "lost")):
        one.track(patches[0])
        assert one.track(patches[1]).status == status


def test_keyframes_that_look_at_the_same_place_are_tied_together_and_that_helps() -> None:
    capture = open_capture(data_folder() / "house" / "bedroom")
    indices = range(0, 120, 3)
    tied, chain = tracker(), tracker(overlap_edges=0)
    for i in indices:
        frame = capture[i]
        tied.track(frame)
        chain.track(frame)
    assert len(chain.edges) == len(chain.records.keyframe_index) - 1
    assert sum(edge.uncertain for edge in tied.edges) > len(chain.edges)
    assert all(edge.source - edge.target > 1 for edge in tied.edges if edge.uncertain)
    before = [T.copy() for T in tied.records.T_world_keyframe]
    tied.optimize()
    moved = [np.abs(a - b).max() for a, b in zip(before, tied.records.T_world_keyframe, strict=True)]
    assert moved[0] < 1e-9
    assert 0 < max(moved) < 0.05


@pytest.mark.parametrize("width", [640, 960, 1280])
def test_a_smaller_view_has_its_depth_exactly_where_its_camera_says(width) -> None:
    camera = Intrinsics(width, width * 3 // 4, 0.9 * width, 0.9 * width, 0.51 * width, 0.37 * width)
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    depth = (2.0 / (1.0 + 0.4 * x - 0.3 * y)).astype(np.float32)  # the plane z + 0.4 x - 0.3 y = 2
    frame = Frame(0, 0.0, np.zeros((*depth.shape, 3), np.uint8), depth, camera)
    x, y, z = tracker()._view(frame).points.T
    assert len(z) > 100
    np.testing.assert_allclose(z + 0.4 * x - 0.3 * y, 2.0, atol=1e-4)


def test_a_restored_tracker_goes_on_as_if_nothing_had_happened() -> None:
    kitchen = open_capture(data_folder() / "7scenes-kitchen")
    whole, part = tracker(), tracker()
    frames = [kitchen[i] for i in range(0, 60, 5)]
    for frame in frames:
        whole.track(frame)
    for frame in frames[:7]:
        part.track(frame)
    rest = tracker()
    rest.restore(part.state(), [kitchen[i] for i in part.records.keyframe_index])
    for frame in frames[7:]:
        rest.track(frame)
    np.testing.assert_allclose(
        rest.trajectory(kitchen.timestamps).T_world_cam, whole.trajectory(kitchen.timestamps).T_world_cam, atol=1e-3
    )
    assert len(rest.edges) == len(whole.edges)


def test_known_takes_the_captures_poses_and_says_when_there_are_none(tmp_path) -> None:
    known = registry.load("tracking", "known")
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
    known = registry.load("tracking", "known")
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
    assert overlap(view.points, np.eye(4), view) == 1.0
    assert overlap(view.points, motion(180, 0), view) == 0.0
    assert 0.3 < overlap(view.points, motion(0, 1.0), view) < 0.7
    behind = wall_frame(3.0)
    far = DepthView(behind.depth_m, behind.intrinsics, sample_points(behind.depth_m, behind.intrinsics))
    T_far_near = np.eye(4)
    T_far_near[2, 3] = 1.0
    assert overlap(view.points, T_far_near, far) == 1.0
    assert mutual_overlap(view, far, T_far_near) < 0.6
