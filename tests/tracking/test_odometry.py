"""Open3D's odometry as a tracker: a real scan, reported loss, overlap edges, resuming."""

import numpy as np
import pytest
from scenes import wall_frame
from small_captures import data_folder

from freeocc3d.capture import open_capture
from freeocc3d.core.transforms import invert
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.tracking.trackers import odometry


def tracker(**options) -> odometry.OdometryTracker:
    return odometry.load(odometry.Options(**options), None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("capture", "step", "centimeters", "degrees"),
    # The kitchen's color and depth are only roughly registered, and its own poses uncertain by a centimeter.
    [("7scenes-kitchen", 3, 10.0, 3.0), ("house/bedroom", 2, 2.0, 0.7)],
)
def test_a_scan_is_followed_without_its_poses(capture, step, centimeters, degrees) -> None:
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
        assert 100 * np.linalg.norm(error[:3, 3]) < centimeters
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
    assert trajectory.status[2] == "interpolated"  # between the frames before and after it
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
    rest.restore(part.state(), kitchen.__getitem__)
    for frame in frames[7:]:
        rest.track(frame)
    np.testing.assert_allclose(  # Open3D's parallel sums differ from call to call
        rest.trajectory(kitchen.timestamps).T_world_cam, whole.trajectory(kitchen.timestamps).T_world_cam, atol=1e-3
    )
    assert len(rest.edges) == len(whole.edges)
