"""From a video to a map: the built-in room as a video file, with a trajectory and points without a unit."""

from pathlib import Path

import av
import numpy as np
import open3d as o3d
import pytest

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import NOMINAL_DEPTH
from freeocc3d.core.transforms import back_project, rotations_to_quats, transform
from freeocc3d.editing import scaling
from freeocc3d.pipeline import run
from freeocc3d.query.scan_map import Map
from freeocc3d.settings import config
from freeocc3d.storage.manifest import MapScale

UNIT_M = 2.5
"""Meters per unit of what the other system gives."""

ROOM = {"synthetic": {"width": 160, "height": 120, "frames": 36, "noise": False}}


def write_tum(path: Path, times: np.ndarray, T: np.ndarray) -> None:
    quats = rotations_to_quats(T[:, :3, :3])
    np.savetxt(path, np.c_[times, T[:, :3, 3], quats[:, [1, 2, 3, 0]]], "%.9f")


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("video")
    room = open_capture("builtin:room", None, ROOM)
    camera, points = room[0].intrinsics, []
    with av.open(str(folder / "scan.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12"})
        stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
        for index in range(len(room)):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(room[index].color, format="rgb24")))
            depth_m = room.exact_depth(index)  # type: ignore[attr-defined]
            v, u = np.nonzero(depth_m[::2, ::2])
            pixels = 2 * np.stack((u, v), axis=1)
            points.append(transform(room.pose(index), back_project(pixels, depth_m[2 * v, 2 * u], camera)))
        container.mux(stream.encode(None))
    T = np.stack([room.pose(index) for index in range(len(room))])
    times = np.arange(len(room)) / 30
    write_tum(folder / "metric.txt", times, T)
    T[:, :3, 3] /= UNIT_M
    write_tum(folder / "other.txt", times, T)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.concatenate(points) / UNIT_M))
    o3d.io.write_point_cloud(str(folder / "points.ply"), cloud)
    return folder


def made(scan: Path, output: Path, **capture: object) -> Map:
    camera = open_capture("builtin:room", None, ROOM)[0].intrinsics
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    given = {"path": str(scan / "other.txt"), "points": str(scan / "points.ply"), "scale": None}
    settings = {
        "capture": {"intrinsics": intrinsics, **capture},
        "tracking": {"backend": "file", "file": given},
        "fitting": {"passes": 0},
    }
    return run.reconstruct(scan / "scan.mp4", output, settings)


def codes(scan_map) -> set[str]:
    return {warning["code"] for warning in scan_map.report["warnings"]}


def test_a_video_becomes_a_map_whose_scale_is_said_to_be_unknown_and_can_be_given(scan: Path, tmp_path: Path) -> None:
    scan_map = made(scan, tmp_path / "map")
    assert scan_map.manifest.capture.format == "video"
    assert scan_map.manifest.scale == MapScale(metric=False, by="none", factor=1.0)
    assert "scale-unknown" in codes(scan_map)
    cell = config.load_saved(scan_map.path / "config.yaml").gaussians.cell_size
    assert cell == pytest.approx(0.01 * NOMINAL_DEPTH)
    assert np.median(scan_map.gaussians.scales[:, 0]) == pytest.approx(0.7 * cell, rel=1e-3)
    assert "intrinsics-unknown" not in codes(scan_map)
    assert scan_map.trajectory.has_pose.all()
    assert scaling.scale_by_poses(scan_map, str(scan / "metric.txt")) == pytest.approx(UNIT_M, rel=1e-3)
    assert scaling.scale_by_camera_height(scan_map, 1.5) == pytest.approx(UNIT_M, rel=0.06)


def test_with_a_scale_given_from_the_start_the_map_is_metric(scan: Path, tmp_path: Path) -> None:
    scan_map = made(scan, tmp_path / "map", scale=UNIT_M)
    assert scan_map.manifest.scale == MapScale(metric=True, by="given", factor=UNIT_M)
    assert "scale-unknown" not in codes(scan_map)
    assert config.load_saved(scan_map.path / "config.yaml").gaussians.cell_size is None
    room = open_capture("builtin:room", None, ROOM)
    T_world_map = np.array(scan_map.manifest.T_world_map)
    centers = transform(T_world_map, scan_map.trajectory.T_world_cam[:, :3, 3])
    np.testing.assert_allclose(centers, [room.pose(index)[:3, 3] for index in range(36)], atol=1e-5)
    truth = room.ground_truth(0.08)  # type: ignore[attr-defined]
    occupied = truth["origin"] + (np.argwhere((truth["labels"] > 0) & (truth["labels"] != 255)) + 0.5) * 0.08
    found = transform(T_world_map, scan_map.occupancy.centers(scan_map.occupancy.occupied_voxels()))
    near = np.array([np.abs(occupied - center).max(axis=1).min() for center in found[::20]])
    assert (near < 0.16).mean() > 0.9


def test_a_guessed_camera_is_reported(scan: Path, tmp_path: Path) -> None:
    settings = {
        "capture": {"stop": 8},
        "tracking": {"backend": "file", "file": {"path": "other.txt", "points": "points.ply", "scale": None}},
        "fitting": {"passes": 0},
    }
    scan_map = run.reconstruct(scan / "scan.mp4", tmp_path / "map", settings)
    (warning,) = (one["text"] for one in scan_map.report["warnings"] if one["code"] == "intrinsics-unknown")
    assert "a guess" in warning
