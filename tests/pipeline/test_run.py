"""From a folder to a map: the whole run on the built-in room and on a piece of a real scan; bad input."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
from pipeline_runs import ONE_PASS, ROOM, listing, notices
from small_captures import data_folder, truncate, write_image, write_scannet, write_seven_scenes

import freeocc3d
from freeocc3d.capture import open_capture
from freeocc3d.core.errors import CaptureError, ConfigError, FreeOccError, MapError, TrackingError
from freeocc3d.core.progress import Progress
from freeocc3d.core.threads import count_threads
from freeocc3d.core.transforms import transform
from freeocc3d.core.types import FREE, OCCUPIED
from freeocc3d.settings import config
from freeocc3d.storage import map_files


def test_the_room_becomes_a_map_with_every_layer(room) -> None:
    assert (room.trajectory.has_pose[:24]).all()
    assert (room.trajectory.status[24:] == "unused").all()
    assert len(room.gaussians) > 500
    states = room.occupancy.state
    assert np.count_nonzero(states == OCCUPIED) > 300
    assert np.count_nonzero(states == FREE) > np.count_nonzero(states == OCCUPIED)
    assert len(room.occupancy.features) == len(room.occupancy.occupied_voxels())
    assert room.gaussian_features.shape == (len(room.gaussians), room.manifest.encoder.dimension)
    assert len(room.keyframes) == len(room.trajectory.keyframes)
    assert {p.name for p in room.path.iterdir()} == {
        "map.yaml", "config.yaml", "report.json", "trajectory.txt", "gaussians.ply", "occupancy.npz", "features.npz",
        "keyframes", "trajectory.png", "gaussians.png",
    }  # fmt: skip


def test_another_number_of_threads_makes_the_same_map(tmp_path, room) -> None:
    threads = "1" if count_threads() > 1 else "2"
    code = f"import freeocc3d; freeocc3d.reconstruct('builtin:room', {str(tmp_path / 'one')!r}, {ROOM!r})"
    subprocess.run([sys.executable, "-c", code], env={**os.environ, "OMP_NUM_THREADS": threads}, check=True)
    one, many = listing(tmp_path / "one"), listing(room.path)
    assert one.keys() == many.keys()
    timed = {"report.json", "map.yaml"}  # the latter has the checksum of the former
    assert [name for name in one.keys() - timed if one[name] != many[name]] == []


def test_the_rooms_poses_are_right(room) -> None:
    capture = open_capture("builtin:room", *_synthetic())
    first = np.linalg.inv(capture.pose(int(room.trajectory.keyframes[0])))
    T_first_map = np.array(room.manifest.T_first_camera)
    for i in range(24):
        error = np.linalg.inv(first @ capture.pose(i)) @ T_first_map @ room.trajectory.T_world_cam[i]
        assert np.linalg.norm(error[:3, 3]) < 0.03


def _synthetic():
    settings = config.resolve(ROOM)
    return settings.capture, settings.backends["capture"]


def test_means_on_file_are_their_anchors_at_the_files_poses(room) -> None:
    g, T = room.gaussians, room.trajectory.T_world_keyframe
    world = np.einsum("nij,nj->ni", T[g.anchor_keyframe, :3, :3], g.anchor_cam.astype(float))
    np.testing.assert_allclose(world + T[g.anchor_keyframe, :3, 3], g.means, atol=1e-4)


def test_the_report_says_how_well_the_map_renders(room) -> None:
    rendering = json.loads((room.path / "report.json").read_text())["rendering"]
    assert rendering["psnr_measured"] > 20
    assert 0 < rendering["depth_l1_m"] < 0.15
    assert 0.8 < rendering["covered"] <= 1
    assert cv2.imread(str(room.path / map_files.RENDER_PICTURE)).std() > 10


def test_a_pose_free_run_never_reads_poses_or_class_images(tmp_path, monkeypatch) -> None:
    from freeocc3d.capture.readers.seven_scenes import Reader

    def forbidden(self, index):
        raise AssertionError("the truth was read")

    monkeypatch.setattr(Reader, "pose", forbidden)
    monkeypatch.setattr(Reader, "labels", forbidden)
    made = freeocc3d.reconstruct(
        data_folder() / "7scenes-kitchen",
        tmp_path / "map",
        {"capture": {"stop": 40, "stride": 4}, **ONE_PASS},
    )
    assert made.manifest.counts.frames_with_pose == 10
    assert made.manifest.counts.voxels.occupied > 500


def test_overwrite_replaces_a_map_and_leaves_neighboring_folders_alone(tmp_path, room) -> None:
    output = shutil.copytree(room.path, tmp_path / "map")
    (tmp_path / "map.old").mkdir()
    (tmp_path / "map.old" / "backup.txt").write_text("mine")
    short = {**ROOM, "capture": {**ROOM["capture"], "stop": 4}}
    made = freeocc3d.reconstruct("builtin:room", output, short, overwrite=True)
    assert made.manifest.counts.frames_with_pose == 4
    assert (tmp_path / "map.old" / "backup.txt").read_text() == "mine"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["map", "map.old"]
    (tmp_path / "next.partial").mkdir()
    (tmp_path / "next.partial" / "notes.txt").write_text("mine")
    for options in ({}, {"overwrite": True}, {"resume": True}):
        with pytest.raises(MapError, match="in the way"):
            freeocc3d.reconstruct("builtin:room", tmp_path / "next", short, **options)
    with pytest.raises(MapError, match="cannot be the name"):
        freeocc3d.reconstruct("builtin:room", ".", short)


def test_an_existing_map_is_not_touched_without_overwrite(tmp_path, room) -> None:
    output = shutil.copytree(room.path, tmp_path / "map")
    before = listing(output)
    with pytest.raises(MapError, match="--overwrite"):
        freeocc3d.reconstruct("builtin:room", output, ROOM)
    with pytest.raises(CaptureError):
        freeocc3d.reconstruct(tmp_path / "nothing", output, overwrite=True)
    assert listing(output) == before
    assert [p.name for p in tmp_path.iterdir()] == ["map"]


def test_an_old_name_is_warned_of_at_once_and_in_the_report(tmp_path) -> None:
    said = []

    class Heard(Progress):
        def warn(self, text: str) -> None:
            said.append(text)

    given = {**ROOM, "capture": {**ROOM["capture"], "stop": 4}, "gaussians": {"initialisation": "isotropic"}}
    made = freeocc3d.reconstruct("builtin:room", tmp_path / "map", given, progress=Heard())
    (notice,) = (notice for notice in notices(made) if notice.code == "option-renamed")
    assert notice.text in said
    assert "gaussians.initialization" in notice.text
    assert made.settings.notices == ()


def test_a_folder_that_is_no_map_is_never_overwritten(tmp_path) -> None:
    precious = tmp_path / "home"
    precious.mkdir()
    (precious / "thesis.txt").write_text("years of work")
    with pytest.raises(MapError, match="not a map"):
        freeocc3d.reconstruct("builtin:room", precious, ROOM, overwrite=True)
    assert (precious / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"traking": {}}, "tracking"),
        ({"tracking": {"odometry": {"itertions": [1, 1, 1]}}}, "iterations"),
        ({"occupancy": {"voxel_size": "big"}}, "must be a number from 0.001 to 100"),
        ({"tracking": {"backend": "rgdb"}}, "rgbd"),
        ({"language": {"encoder": "colr"}}, "did you mean .color"),
        ({"occupancy": {"voxel_size": -0.1}}, "voxel_size"),
    ],
)
def test_a_wrong_configuration_is_named_before_any_work_and_leaves_nothing(tmp_path, settings, message) -> None:
    with pytest.raises(ConfigError, match=message):
        freeocc3d.reconstruct("builtin:room", tmp_path / "map", settings)
    assert list(tmp_path.iterdir()) == []


def test_no_such_capture_leaves_nothing(tmp_path) -> None:
    with pytest.raises(CaptureError, match="no folder"):
        freeocc3d.reconstruct(tmp_path / "nothing", tmp_path / "map")
    assert list(tmp_path.iterdir()) == []


def test_frames_that_cannot_be_read_are_skipped_and_counted(tmp_path) -> None:
    scan = tmp_path / "scan"
    scan.mkdir()
    for i in range(20):
        for kind in ("color.jpg", "depth.png"):
            shutil.copy(data_folder() / "7scenes-kitchen" / f"frame-{i:06d}.{kind}", scan)
    truncate(scan / "frame-000007.color.jpg")
    truncate(scan / "frame-000011.depth.png")
    made = freeocc3d.reconstruct(scan, tmp_path / "map", ONE_PASS)
    assert made.report["frames"]["broken"] == 2
    assert len(made.report["broken"]) == 2
    assert "frame-000007.color.jpg" in made.report["broken"]["7"]
    assert made.trajectory.status[7] == made.trajectory.status[11] == "broken"
    (warning,) = (notice for notice in notices(made) if notice.code == "broken-frames")
    assert "2 frames could not be read" in warning.text
    for i in (3, 4, 5):
        truncate(scan / f"frame-{i:06d}.color.jpg")
    with pytest.raises(CaptureError, match=r"capture\.max_broken"):
        freeocc3d.reconstruct(scan, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_scan_without_any_depth_says_so(tmp_path) -> None:
    scan = write_scannet(tmp_path / "scan", 4)
    for path in (scan / "depth").iterdir():
        cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
    with pytest.raises(TrackingError, match=r"capture\.depth_scale"):
        freeocc3d.reconstruct(scan, tmp_path / "map")
    assert [p.name for p in tmp_path.iterdir()] == ["scan"]


def test_depth_in_the_wrong_unit_is_warned_about(tmp_path) -> None:
    scan = write_seven_scenes(tmp_path / "scan", 4)
    told: list[str] = []

    class Listener(Progress):
        def warn(self, text: str) -> None:
            told.append(text)

    with pytest.raises(FreeOccError):
        freeocc3d.reconstruct(scan, tmp_path / "map", {"capture": {"depth_scale": 1.0}}, progress=Listener())
    assert any("capture.depth_scale" in text for text in told)


def test_labels_of_the_capture_answer_by_class(tmp_path) -> None:
    made = freeocc3d.reconstruct(
        data_folder() / "house" / "bedroom",
        tmp_path / "map",
        {
            "capture": {"stop": 60, "stride": 6},
            "tracking": {"backend": "known"},
            "language": {"encoder": "labels"},
            "fitting": {"passes": 0},
        },
    )
    found = made.query("bed")
    assert found.matched
    truth = np.load(data_folder() / "house" / "bedroom" / "ground_truth.npz")
    centers = made.occupancy.centers(made.occupancy.occupied_voxels()[found.regions[0].rows])
    centers = transform(np.array(made.manifest.T_world_map), centers)
    voxel = np.floor((centers - truth["origin"]) / truth["voxel_size"]).astype(int)
    labels = truth["labels"][tuple(voxel.T)]
    bed = truth["classes"].tolist().index("bed")
    assert (labels == bed).sum() > 0.7 * ((labels != 255) & (labels != 0)).sum()
    assert not made.query("bathtub").matched


def test_two_places_are_two_submaps_and_the_largest_is_mapped(two_places) -> None:
    from freeocc3d.cli.map_summary import summary_lines

    made = two_places
    assert made.manifest.counts.submaps == 2
    assert made.manifest.counts.frames_with_pose == 15
    assert made.report["frames"]["apart"] == 8
    assert [(s["first"], s["last"], s["mapped"]) for s in made.report["submaps"]] == [(0, 14, True), (15, 22, False)]
    assert (made.trajectory.status[15:] == "apart").all()
    (warning,) = (notice.text for notice in notices(made) if notice.code == "submaps-apart")
    assert "8 frames" in warning
    assert "frame 15" in warning
    assert len(made.keyframes) == len(made.trajectory.keyframes) == len(made.manifest.keyframes)
    assert [frame.index for frame in made.keyframes] == made.trajectory.keyframes.tolist()
    assert len(list((made.path / "keyframes").glob("*.color.jpg"))) == len(made.keyframes)
    assert made.gaussians.anchor_keyframe.max() < len(made.keyframes)
    text = "\n".join(summary_lines(made))
    assert "2 submaps" in text
    assert "frames 15 to 22: 8 with a pose" in text
    assert "apart, not in the map" in text
    assert cv2.imread(str(made.path / "trajectory.png")).shape[2] == 3


def test_poses_of_another_system_make_a_map(tmp_path) -> None:
    capture = data_folder() / "house" / "bedroom"
    poses = np.stack([open_capture(capture).pose(i) for i in range(40)])
    np.savetxt(tmp_path / "kitti.txt", poses.reshape(40, 16)[:, :12])
    settings = {
        "capture": {"stop": 40, "stride": 4},
        "tracking": {"backend": "file", "file": {"path": str(tmp_path / "kitti.txt")}},
        "fitting": {"passes": 0},
    }
    made = freeocc3d.reconstruct(capture, tmp_path / "map", settings)
    assert made.manifest.counts.frames_with_pose == 10
    T_world_cam = np.array(made.manifest.T_world_map) @ made.trajectory.T_world_cam[8]
    np.testing.assert_allclose(T_world_cam, poses[8], atol=1e-5)
    assert made.manifest.world.startswith("world frame of the trajectory file")


def test_a_color_camera_of_another_focal_length_is_reported_and_corrected(tmp_path) -> None:
    kitchen = data_folder() / "7scenes-kitchen"
    given = {"capture": {"stop": 4, "color_focal": 0.9}, "fitting": {"passes": 0}}
    made = freeocc3d.reconstruct(kitchen, tmp_path / "given", given)
    assert made.report["color_focal"] == 0.9
    assert not made.report["warnings"]
    left = {**given, "capture": {"stop": 4, "color_focal": 1.0}}
    left = freeocc3d.reconstruct(kitchen, tmp_path / "left", left)
    assert np.abs(made.keyframes[0].color.astype(int) - left.keyframes[0].color).mean() > 5
    np.testing.assert_array_equal(made.keyframes[0].depth_m, left.keyframes[0].depth_m)
    walk = {"capture": {"stop": 250, "stride": 10}, "fitting": {"passes": 0}}
    found = freeocc3d.reconstruct(kitchen, tmp_path / "found", walk)
    assert found.report["color_focal"] == pytest.approx(0.903, abs=0.02)
    (warning,) = (notice.text for notice in notices(found) if notice.code == "color-focal-corrected")
    assert "0.9" in warning
    assert "capture.color_focal=1" in warning


def test_a_broken_first_frame_does_not_keep_the_scan_from_telling_its_camera(tmp_path) -> None:
    """No file states the camera, and the first image is cut off."""
    room = open_capture("builtin:room", None, {"synthetic": {"frames": 120, "width": 320, "height": 240}})
    for index in range(30):
        frame = room[index]
        write_image(tmp_path / "scan" / "color" / f"{index}.png", frame.color)
        write_image(tmp_path / "scan" / "depth" / f"{index}.png", (frame.depth_m * 1000).round().astype(np.uint16))
    truncate(tmp_path / "scan" / "color" / "0.png")
    made = freeocc3d.reconstruct(tmp_path / "scan", tmp_path / "map", {"fitting": {"passes": 0}})
    assert {"focal-estimated", "broken-frames"} <= {notice.code for notice in notices(made)}
    assert made.report["frames"]["broken"] == 1
