"""Trajectory files of other systems: each format against known poses, and the frames that the poses belong to."""

import json
from pathlib import Path

import numpy as np
import pytest
from scenes import CAMERA, wall_frame
from small_captures import pose_matrix, write_seven_scenes

from freeocc3d.capture import PoseFile, open_capture, read_trajectory
from freeocc3d.core.errors import CaptureError, ConfigError, TrackingError
from freeocc3d.core.transforms import invert, rotations_to_quats
from freeocc3d.tracking.trackers import file

COUNT = 6
POSES = np.stack([pose_matrix(i) for i in range(COUNT)])


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return open_capture(write_seven_scenes(tmp_path_factory.mktemp("capture") / "scan", COUNT, poses=False))


def write_tum(path: Path, T=POSES, times=None) -> Path:
    quats = rotations_to_quats(T[:, :3, :3])
    times = np.arange(len(T), dtype=float) if times is None else times
    np.savetxt(path, np.column_stack((times, T[:, :3, 3], quats[:, [1, 2, 3, 0]])), fmt="%.9f", header="a comment")
    return path


def write_log(path: Path, T=POSES) -> Path:
    with path.open("w") as log:
        for n, pose in enumerate(T):
            log.write(f"{n} {n} {n + 1}\n")
            np.savetxt(log, pose, fmt="%.9f")
    return path


def write_nerfstudio(path: Path, T=POSES) -> Path:
    flip = np.diag((1.0, -1.0, -1.0, 1.0))
    frames = [
        {"file_path": f"images/frame-{n:06d}.color.png", "transform_matrix": (pose @ flip).tolist()}
        for n, pose in enumerate(T)
    ]
    path.write_text(json.dumps({"fl_x": 500, "frames": frames}))
    return path


def write_colmap(folder: Path, T=POSES) -> Path:
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 32 24 32 32 16 12\n")
    (folder / "points3D.txt").write_text("")
    lines = []
    for n, T_cam_world in enumerate(invert(T)):
        w, x, y, z = rotations_to_quats(T_cam_world[None, :3, :3])[0]
        t = T_cam_world[:3, 3]
        lines += [f"{n + 1} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 frame-{n:06d}.color.png", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_form(form: str, folder: Path) -> Path:
    if form == "tum":
        return write_tum(folder / "poses.txt")
    if form in ("kitti", "replica"):
        columns = 12 if form == "kitti" else 16
        np.savetxt(folder / "poses.txt", POSES.reshape(COUNT, 16)[:, :columns], fmt="%.9f")
        return folder / "poses.txt"
    if form == "log":
        return write_log(folder / "poses.log")
    if form == "nerfstudio":
        return write_nerfstudio(folder / "transforms.json")
    if form == "colmap":
        return write_colmap(folder / "sparse" / "0").parents[1]
    for n, pose in enumerate(POSES):
        np.savetxt(folder / f"frame-{n:06d}.pose.txt", pose, fmt="%.9f")
    return folder


FORMS = ("tum", "kitti", "replica", "log", "nerfstudio", "colmap", "seven_scenes")


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_each_frame_its_pose(scan, tmp_path, form) -> None:
    found = read_trajectory(write_form(form, tmp_path))
    np.testing.assert_allclose(found.of_frames(scan), POSES, atol=1e-6)
    np.testing.assert_allclose(found.times(), np.arange(COUNT))


@pytest.mark.parametrize("form", FORMS)
def test_the_tracker_takes_them(scan, tmp_path, form) -> None:
    tracker = file.load(file.Options(path=str(write_form(form, tmp_path))), scan)
    for i in range(COUNT):
        assert tracker.track(scan[i]).T_world_cam is not None
    trajectory = tracker.trajectory(scan.timestamps)
    np.testing.assert_allclose(trajectory.T_world_cam, POSES, atol=1e-6)


def test_a_binary_model_is_read_as_the_text_one(scan, tmp_path) -> None:
    import pycolmap

    text = write_colmap(tmp_path / "text")
    model = pycolmap.Reconstruction()
    model.read_text(str(text))
    (tmp_path / "binary").mkdir()
    model.write_binary(str(tmp_path / "binary"))
    np.testing.assert_allclose(read_trajectory(tmp_path / "binary").of_frames(scan), POSES, atol=1e-6)
    np.testing.assert_allclose(read_trajectory(tmp_path / "binary" / "images.bin").of_frames(scan), POSES, atol=1e-6)


def test_names_of_windows_are_those_of_their_last_part(scan, tmp_path) -> None:
    path = write_nerfstudio(tmp_path / "transforms.json")
    path.write_text(path.read_text().replace("images/", "C:\\\\2024\\\\images\\\\"))
    found = read_trajectory(path)
    assert found.names[1] == "frame-000001.color.png"
    np.testing.assert_allclose(found.of_frames(scan), POSES, atol=1e-6)


def test_times_are_matched_to_the_nearest_within_the_tolerance(scan, tmp_path) -> None:
    times = np.array((0.01, 1.015, 2.5, 3.0, 4.0, 40.0))
    found = read_trajectory(write_tum(tmp_path / "t.txt", times=times))
    matched = np.isfinite(found.of_frames(scan)[:, 0, 0])
    assert matched.tolist() == [True, True, False, True, True, False]
    assert np.isfinite(found.of_frames(scan, 0.6)[:, 0, 0]).sum() == 5
    order = [3, 0, 5, 1, 4, 2]
    shuffled = read_trajectory(write_tum(tmp_path / "s.txt", T=POSES[order], times=times[order]))
    np.testing.assert_array_equal(shuffled.of_frames(scan), found.of_frames(scan))


def test_keyframe_trajectories_leave_the_other_frames_without_a_pose(scan, tmp_path) -> None:
    path = write_tum(tmp_path / "t.txt", T=POSES[[0, 5]], times=np.array((0.0, 5.0)))
    tracker = file.load(file.Options(path=str(path)), scan)
    for i in range(COUNT):
        tracker.track(scan[i])
    assert tracker.trajectory(scan.timestamps).status[[1, 4]].tolist() == ["lost", "lost"]


def test_names_are_matched_by_their_numbers_where_they_differ(scan) -> None:
    names = tuple(f"rgb/{n:04d}.jpg" for n in range(COUNT))
    found = PoseFile(Path("x"), POSES[::-1], names=tuple(Path(name).name for name in reversed(names)))
    np.testing.assert_allclose(found.of_frames(scan), POSES)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.txt", "", "is not a trajectory"),
        ("a.txt", "1 2 3\n", "is not a trajectory"),
        ("a.txt", "0 0 0 0 0 0 0 0\n", "is not a trajectory"),
        ("a.txt", "0 1 2 nan 0 0 0 1\n", "is not a trajectory"),
        ("a.txt", "2 " * 16, "not a rigid"),
        ("a.txt", "\x00\xff", "is not a text file"),
        ("a.log", "-1 0 0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "is not a trajectory"),
        ("a.log", "99999999999 0 0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "is not a trajectory"),
        ("transforms.json", "{}", "lacks 'frames'"),
        ("transforms.json", "[1, 2]", "a list instead of a group of keys"),
        (
            "transforms.json",
            '{"frames": [{"file_path": "a", "transform_matrix": [[1, 2]]}]}',
            r"transform_matrix' has 1 entries instead of 4",
        ),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n\n", "no readable COLMAP model"),
    ],
)
def test_what_is_no_trajectory_is_reported_in_a_sentence(tmp_path, name, text, said) -> None:
    (tmp_path / name).write_text(text, encoding="latin-1")
    with pytest.raises(CaptureError, match=said):
        read_trajectory(tmp_path / name)


def test_missing_files_and_folders_without_poses(tmp_path) -> None:
    with pytest.raises(CaptureError, match="There is no trajectory"):
        read_trajectory(tmp_path / "absent.txt")
    with pytest.raises(CaptureError, match="holds no trajectory"):
        read_trajectory(tmp_path)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (PoseFile(Path("a.txt"), POSES, timestamps=np.arange(COUNT) + 1e6), "its times are 1000000.00"),
        (
            PoseFile(Path("m"), POSES, names=tuple("abcdef")),
            "its first image is a, the capture's frame-000000.color.png",
        ),
    ],
)
def test_poses_of_another_capture_are_reported(scan, found, said) -> None:
    with pytest.raises(CaptureError, match=said):
        found.of_frames(scan)


# The tracker


ROOM = {"synthetic": {"frames": 60, "width": 320, "height": 240, "noise": True}}


@pytest.fixture(scope="module")
def room():
    return open_capture("builtin:room", None, ROOM)


def room_poses(room, scale: float = 1.0) -> np.ndarray:
    T = np.stack([room.pose(i) for i in range(len(room))])
    T[:, :3, 3] /= scale
    return T


def test_a_monocular_scale_is_found_from_depth(room, tmp_path) -> None:
    path = write_tum(tmp_path / "t.txt", room_poses(room, scale=2.7), room.timestamps)
    tracker = file.load(file.Options(path=str(path), scale=None), room)
    measured = np.linalg.norm(tracker.T_world_cam[30, :3, 3] - tracker.T_world_cam[0, :3, 3])
    true = np.linalg.norm(room.pose(30)[:3, 3] - room.pose(0)[:3, 3])
    assert measured == pytest.approx(true, rel=0.02)
    given = file.load(file.Options(path=str(path), scale=2.7), room)
    np.testing.assert_allclose(given.T_world_cam, room_poses(room), atol=1e-6)


def test_a_scale_that_nothing_tells_is_asked_for(scan, tmp_path) -> None:
    with pytest.raises(TrackingError, match=r"Give tracking\.file\.scale"):
        file.load(file.Options(path=str(write_tum(tmp_path / "t.txt")), scale=None), scan)


def test_options_are_checked(scan, tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"tracking\.file\.path"):
        file.load(file.Options(), scan)
    with pytest.raises(ConfigError, match="scale"):
        file.Options(path="x", scale=0.0)
    path = str(write_tum(tmp_path / "t.txt"))
    with pytest.raises(CaptureError, match=r"Cannot read the point cloud .*absent"):
        file.load(file.Options(path=path, points=str(tmp_path / "absent.ply")), scan)
    (tmp_path / "bad.ply").write_text("hello")
    with pytest.raises(CaptureError, match="is not a PLY file"):
        file.load(file.Options(path=path, points=str(tmp_path / "bad.ply")), scan)


def test_a_file_in_the_captures_folder_is_found_there(scan) -> None:
    write_tum(scan.path / "inside.txt")
    tracker = file.load(file.Options(path="inside.txt"), scan)
    np.testing.assert_allclose(tracker.T_world_cam, POSES, atol=1e-6)


def test_points_become_depth_where_there_is_none_and_hide_what_is_behind() -> None:
    frame = wall_frame(2.0)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].reshape(2, -1)
    rays = np.stack(((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))), axis=1)
    near = (1.5 * rays[::2]).astype(np.float32)  # a wall with gaps
    far = (3.0 * rays).astype(np.float32)
    behind = np.array([[0, 0, -2.0]], np.float32)
    depth = file.project_depth(np.concatenate((far, near, behind)), frame)
    np.testing.assert_allclose(depth.ravel()[::2], 1.5, rtol=1e-6)
    assert (depth.ravel()[1::2] == 0).all()


def test_a_point_cloud_completes_frames_and_leaves_what_was_measured(scan, tmp_path) -> None:
    import open3d as o3d

    # The cloud is the wall that frame 0 sees at 2 m, in a world of half the size.
    depth = scan[0].depth_m
    K = scan[0].intrinsics
    v, u = np.mgrid[: K.height, : K.width].reshape(2, -1)
    wall = 2.0 * np.stack(((u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(len(u))), axis=1)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(wall / 2))
    o3d.io.write_point_cloud(str(tmp_path / "cloud.ply"), cloud)
    T = POSES.copy()
    T[:, :3, 3] /= 2
    path = write_tum(tmp_path / "t.txt", T)
    options = file.Options(path=str(path), scale=2.0, points=str(tmp_path / "cloud.ply"))
    completed = file.load(options, scan).prepare_frame(scan[0])
    assert (depth == 0).any()
    np.testing.assert_allclose(completed.depth_m[depth == 0], 2.0, atol=1e-3)
    np.testing.assert_array_equal(completed.depth_m[depth > 0], depth[depth > 0])
