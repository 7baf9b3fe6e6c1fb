"""Writes scans as folders of color and depth images with files beside them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scans import Scan, log_entry, pose_line, write_depth
from small_captures import write_image, write_matrix

TUM_UNITS = 5000.0
LATE_S = 0.0134
"""How much later TUM's depth is."""

_TUM_HEADER = "# color images\n# file: 'rgbd_dataset_{}.bag'\n# timestamp filename\n"


def write_seven_scenes(folder: Path, scan: Scan) -> Path:
    write_matrix(folder / "camera-intrinsics.txt", scan.K)
    for i in range(len(scan)):
        write_image(folder / f"frame-{i:06d}.color.png", scan.color[i])
        write_image(folder / f"frame-{i:06d}.depth.png", scan.stored(i))
        write_matrix(folder / f"frame-{i:06d}.pose.txt", scan.T_world_cam[i])
    return folder


def write_replica(folder: Path, scan: Scan, units: float = 6553.5) -> Path:
    K = scan.K
    camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "scale": units}
    for i in range(len(scan)):
        write_image(folder / "results" / f"frame{i:06d}.png", scan.color[i])
        write_image(folder / "results" / f"depth{i:06d}.png", scan.stored(i, units))
    size = {"w": scan.size[0], "h": scan.size[1]}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera | size}))
    write_matrix(folder / "traj.txt", np.array(scan.T_world_cam).reshape(-1, 16))
    return folder


def write_scannet(folder: Path, scan: Scan) -> Path:
    for i in range(len(scan)):
        write_image(folder / "color" / f"{i}.png", scan.color[i])
        write_image(folder / "depth" / f"{i}.png", scan.stored(i))
        write_matrix(folder / "pose" / f"{i}.txt", scan.T_world_cam[i])
    for kind, K in (("color", scan.K), ("depth", scan.depth_K)):
        write_matrix(folder / "intrinsic" / f"intrinsic_{kind}.txt", widen(K))
        write_matrix(folder / "intrinsic" / f"extrinsic_{kind}.txt", np.eye(4))
    return folder


def widen(K: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) of a (3, 3) matrix."""
    out = np.eye(4)
    out[:3, :3] = K
    return out


def write_tum(
    folder: Path, scan: Scan, lists: str = "rgb depth", recording: str = "room", names: str = "{:.6f}"
) -> Path:
    """names: pattern of the files' names, of seconds.  lists: which of rgb.txt, depth.txt and associations.txt are
    written."""
    texts = {"rgb": _TUM_HEADER.format(recording), "depth": _TUM_HEADER.format(recording), "associations": ""}
    for i, time in enumerate(scan.times):
        color, depth = (f"{kind}/{names.format(at)}.png" for kind, at in (("rgb", time), ("depth", time + LATE_S)))
        write_image(folder / color, scan.color[i])
        write_image(folder / depth, scan.stored(i, TUM_UNITS))
        lines = {"rgb": f"{time:.6f} {color}\n", "depth": f"{time + LATE_S:.6f} {depth}\n"}
        texts["rgb"] += lines["rgb"]
        texts["depth"] += lines["depth"]
        texts["associations"] += f"{lines['rgb'].strip()} {lines['depth']}"
    for kind in lists.split():
        (folder / f"{kind}.txt").write_text(texts[kind])
    poses = "".join(pose_line(time, T) for time, T in zip(scan.times, scan.T_world_cam, strict=True))
    (folder / "groundtruth.txt").write_text(poses)
    return folder


def write_camera(file: Path, scan: Scan, **more: Any) -> Path:
    """A camera as many programs write it. more: other entries."""
    K = scan.K
    camera = {"width": scan.size[0], "height": scan.size[1], "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2]}
    file.write_text(json.dumps({**camera, "cy": K[1, 2], **more}))
    return file.parent


def write_open3d_camera(file: Path, scan: Scan) -> None:
    content = {"width": scan.size[0], "height": scan.size[1], "intrinsic_matrix": scan.K.T.reshape(-1).tolist()}
    file.write_text(json.dumps(content))


def write_tum_with_camera(folder: Path, scan: Scan, lists: str = "rgb depth", names: str = "{:.6f}") -> Path:
    """The calibration is in a file beside the lists."""
    write_tum(folder, scan, lists, names=names)
    return write_camera(folder / "camera.json", scan, depth_scale=TUM_UNITS)


def write_counted_times(folder: Path, scan: Scan, per_second: int) -> Path:
    """Names are times in whole parts of a second, and depth is some milliseconds late."""
    for i, time in enumerate(scan.times):
        whole = round(time * 1000) * per_second // 1000
        write_image(folder / "rgb" / f"{whole}.png", scan.color[i])
        write_image(folder / "depth" / f"{whole + 3 * per_second // 1000}.png", scan.stored(i))
    poses = "".join(pose_line(time, T) for time, T in zip(scan.times, scan.T_world_cam, strict=True))
    (folder / "groundtruth.txt").write_text(poses)
    return write_camera(folder / "camera.json", scan, depth_scale=1000)


def write_pairs(folder: Path, scan: Scan, color: str, depth: str, poses: str = "poses/{:04d}.txt") -> Path:
    """color, depth, poses: patterns of the names of files, of numbers from 1."""
    for i in range(len(scan)):
        write_image(folder / color.format(i + 1), scan.color[i])
        write_depth(folder / depth.format(i + 1), scan.depth_m[i])
        write_matrix(folder / poses.format(i + 1), scan.T_world_cam[i])
    write_matrix(folder / "intrinsics.txt", scan.K)
    return folder


def write_open3d(folder: Path, scan: Scan) -> Path:
    """As Open3D's reconstruction system has them."""
    for i in range(len(scan)):
        write_image(folder / "image" / f"{i + 1:06d}.png", scan.color[i])
        write_image(folder / "depth" / f"{i + 1:06d}.png", scan.stored(i))
    write_open3d_camera(folder / "camera_intrinsic.json", scan)
    (folder / "trajectory.log").write_text("".join(map(log_entry, range(len(scan)), scan.T_world_cam)))
    return folder


def write_redwood(folder: Path, scan: Scan) -> Path:
    """Names hold the number of a frame and its microseconds."""
    for i, time in enumerate(scan.times):
        since = round((time - scan.times[0]) * 1e6)
        write_image(folder / f"color/{i + 1:07d}-{since:012d}.png", scan.color[i])
        write_image(folder / f"depth/{i + 1:07d}-{since + 8000:012d}.png", scan.stored(i))
    write_open3d_camera(folder / "camera_intrinsic.json", scan)
    (folder / "scene_trajectory.log").write_text("".join(map(log_entry, range(len(scan)), scan.T_world_cam)))
    return folder


def write_rtabmap(folder: Path, scan: Scan) -> Path:
    """Numbers have gaps, and each frame has a calibration and a confidence."""
    (folder / "calib").mkdir(parents=True)
    numbers = [22 + 2 * i for i in range(len(scan))]
    for i, number in enumerate(numbers):
        write_image(folder / "rgb" / f"{number}.png", scan.color[i])
        write_image(folder / "depth" / f"{number}.png", scan.stored(i))
        write_image(folder / "confidence" / f"{number}.png", scan.sure((0, 50, 100)))
        data = ", ".join(map(repr, scan.cameras[i].matrix.reshape(-1).tolist()))
        (folder / "calib" / f"{number}.yaml").write_text(
            f"%YAML:1.0\n---\nimage_width: {scan.size[0]}\nimage_height: {scan.size[1]}\n"
            f"camera_matrix:\n   rows: 3\n   cols: 3\n   data: [ {data} ]\n"
        )
    poses = zip(scan.times, scan.T_world_cam, numbers, strict=True)
    lines = [f"{pose_line(time, T).strip()} {number}\n" for time, T, number in poses]
    (folder / "poses.txt").write_text("#timestamp x y z qx qy qz qw id\n" + "".join(lines))
    return folder


def write_bundlefusion(folder: Path, scan: Scan, images: str = "", info: str = "info.txt", depth: str = "png") -> Path:
    """As BundleFusion has it; with ``images`` "sequence", ``info`` "_info.txt" and PGM, as 3RScan."""
    for i in range(len(scan)):
        start = f"{images or '.'}/frame-{i:06d}"
        write_image(folder / f"{start}.color.png", scan.color[i])
        write_depth(folder / f"{start}.depth.{depth}", scan.depth_m[i])
        write_matrix(folder / f"{start}.pose.txt", scan.T_world_cam[i])
    write_info(folder / images / info, scan)
    return folder


def write_info(path: Path, scan: Scan, T_rig_depth: NDArray[np.float64] | None = None, units: float = 1000.0) -> None:
    def numbers(matrix: NDArray[np.float64]) -> str:
        return " ".join(map(repr, matrix.reshape(16).tolist()))

    path.write_text(
        "m_versionNumber = 4\nm_sensorName = StructureSensor\n"
        f"m_colorWidth = {scan.size[0]}\nm_colorHeight = {scan.size[1]}\n"
        f"m_depthWidth = {scan.depth_size[0]}\nm_depthHeight = {scan.depth_size[1]}\nm_depthShift = {units:g}\n"
        f"m_calibrationColorIntrinsic = {numbers(widen(scan.K))} \n"
        f"m_calibrationColorExtrinsic = {numbers(np.eye(4))} \n"
        f"m_calibrationDepthIntrinsic = {numbers(widen(scan.depth_K))} \n"
        f"m_calibrationDepthExtrinsic = {numbers(np.eye(4) if T_rig_depth is None else T_rig_depth)} \n"
        f"m_frames.size = {len(scan)}\n"
    )
