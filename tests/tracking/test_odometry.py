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


@pytest.fixture(scope="module")
def room():
    return open_capture(
        "builtin:room", None, {"synthetic": {"frames": 120, "width": 160, "height": 120, "noise": True}}
    )


@pytest.fixture(scope="module")
def walk(room) -> list[Frame]:
    """A third of the way around the room."""
    return [room[i] for i in range(40)]


def test_a_walk_around_a_room_is_followed_and_its_keyframes_are_tied_together(room, walk) -> None:
    tied, chain = tracker(width=160), tracker(width=160, overlap_edges=0)
    told = [tied.track(frame) for frame in walk]
    for frame in walk:
        chain.track(frame)
    first = invert(room.pose(0))
    trajectory = tied.trajectory(room.timestamps)
    for i, one in enumerate(told):
        assert one.status in ("keyframe", "tracked")
        assert one.T_world_cam is not None
        error = invert(first @ room.pose(i)) @ one.T_world_cam
        assert np.linalg.norm(error[:3, 3]) < 0.03
        np.testing.assert_allclose(trajectory.T_world_cam[i], one.T_world_cam, atol=1e-9)
        assert 0.5 < one.confidence <= 1
    keyframes = tied.records.keyframe_index
    assert trajectory.keyframes.tolist() == keyframes == [i for i, one in enumerate(told) if one.status == "keyframe"]
    assert [(edge.source, edge.target) for edge in chain.edges] == [(k, k - 1) for k in range(1, len(keyframes))]
    certain = [edge for edge in tied.edges if not edge.uncertain]
    assert [(edge.source, edge.target) for edge in certain] == [(k, k - 1) for k in range(1, len(keyframes))]
    others = [edge for edge in tied.edges if edge.uncertain]
    assert others
    assert all(edge.source - edge.target > 1 for edge in others)
    assert max(np.bincount([edge.source for edge in others])) <= 6
    for edge in tied.edges:
        source, target = (first @ room.pose(keyframes[k]) for k in (edge.source, edge.target))
        error = invert(invert(target) @ source) @ edge.T_target_source
        assert np.linalg.norm(error[:3, 3]) < 0.03
    before = [T.copy() for T in tied.records.T_world_keyframe]
    tied.optimize()
    moved = [np.abs(a - b).max() for a, b in zip(before, tied.records.T_world_keyframe, strict=True)]
    assert moved[0] < 1e-9
    assert 0 < max(moved) < 0.05


def test_each_frame_starts_from_constant_velocity_but_after_a_loss(walk, monkeypatch) -> None:
    guesses, t = [], tracker(width=160, keyframe_overlap=0.01)
    register = t._register

    def recorded(source, target, guess):
        guesses.append(guess)
        return register(source, target, guess)

    monkeypatch.setattr(t, "_register", recorded)
    poses = [t.track(frame).T_world_cam for frame in walk[:4]]
    assert len(guesses) == 3
    np.testing.assert_allclose(guesses[0], np.eye(4))
    for n in (1, 2):
        np.testing.assert_allclose(guesses[n], poses[n] @ invert(poses[n - 1]) @ poses[n], atol=1e-9)
    empty = Frame(4, 4.0, walk[4].color, np.zeros_like(walk[4].depth_m), walk[4].intrinsics)
    assert t.track(empty).status == "lost"
    assert len(guesses) == 5, "it is tried without velocity as well"
    np.testing.assert_allclose(guesses[4], poses[3], atol=1e-9)
    t.track(walk[5])
    np.testing.assert_allclose(t._velocity, np.eye(4))
    after = t.track(walk[6]).T_world_cam
    np.testing.assert_allclose(guesses[-1], t.trajectory(np.arange(7.0)).T_world_cam[5], atol=1e-9)
    np.testing.assert_allclose(t._T_keyframe_last, after, atol=1e-9)


def test_each_part_of_the_failure_test_can_fail(walk) -> None:
    good = tracker(width=160)
    good.track(walk[0])
    assert good.track(walk[1]).status == "tracked"
    for strict in ({"min_fitness": 0.999}, {"max_residual": 1e-6}, {"min_information": 1e3}):
        t = tracker(width=160, **strict)
        t.track(walk[0])
        assert t.track(walk[1]).status == "lost", strict


def test_a_tracker_that_is_restored_within_a_walk_goes_on(walk) -> None:
    whole, part, rest = (tracker(width=160) for _ in range(3))
    for frame in walk[:12]:
        whole.track(frame)
    for frame in walk[:7]:
        part.track(frame)
    empty = Frame(7, 7.0, walk[7].color, np.zeros_like(walk[7].depth_m), walk[7].intrinsics)
    part.track(empty)
    rest.restore(part.state(), walk.__getitem__)
    for name, value in part.state().items():
        np.testing.assert_array_equal(rest.state()[name], value)
    told = [rest.track(frame) for frame in walk[8:12]]
    assert all(one.status != "lost" for one in told)
    wanted = whole.trajectory(np.arange(12.0)).T_world_cam[8:]
    np.testing.assert_allclose([one.T_world_cam for one in told], wanted, atol=5e-3)


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
