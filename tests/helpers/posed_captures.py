"""Captures with poses from other programs: Nerfstudio's folders and COLMAP's models."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scans import Scan, plane_scan, write_depth
from small_captures import write_image

from freeocc3d.core.transforms import invert, rotations_to_quats
from freeocc3d.core.types import Intrinsics

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(folder: Path, count: int, depth: bool = True, **more: Any) -> Path:
    """Frames of SIZE by one camera, listed in reverse."""
    return write_transforms(folder, one_camera(plane_scan(count)), "depth/frame_{}.png" if depth else None, **more)


def one_camera(scan: Scan) -> Scan:
    """The scan as if the camera of its first frame had taken all."""
    return replace(scan, cameras=[scan.cameras[0]] * len(scan))


def write_transforms(
    folder: Path, scan: Scan, depth: str | None = "depth/frame_{}.png", units: float = 1000.0,
    key: str = "depth_file_path", **more: Any,
) -> Path:  # fmt: skip
    """Frames in reverse. depth: pattern of depth files.  units: of depth as integers, per meter.  key: of the depth of
    a frame.  more: entries of the file. Frames state their camera if it is not that of the first."""
    frames = []
    for i, camera in enumerate(scan.cameras):
        write_image(folder / "images" / f"frame_{i}.png", scan.color[i])
        T = (scan.T_world_cam[i] @ OPENGL).tolist()
        own = {} if camera == scan.cameras[0] else _stated(camera)
        frames.append({"file_path": f"images/frame_{i}.png", "transform_matrix": T, **own})
        if depth:
            write_depth(folder / depth.format(i), scan.depth_m[i], units)
            frames[-1][key] = depth.format(i)
    content = {"camera_model": "OPENCV", **_stated(scan.cameras[0]), **more, "frames": frames[::-1]}
    folder.joinpath("transforms.json").write_text(json.dumps(content))
    return folder


def _stated(camera: Intrinsics) -> dict[str, float]:
    center = {"cx": camera.cx + 0.5, "cy": camera.cy + 0.5}
    return {"fl_x": camera.fx, "fl_y": camera.fy, **center, "w": camera.width, "h": camera.height}


def write_colmap(
    folder: Path, count: int, camera: str = "", place: str = "sparse/0", depth: float = 5.0, scale: float = 1.0
) -> Path:
    """Frames of SIZE by one camera; otherwise as ``write_model``."""
    return write_model(folder, one_camera(plane_scan(count)), camera, place, depth, scale)


def write_model(
    folder: Path, scan: Scan, camera: str = "", place: str = "sparse/0", depth: float = 5.0, scale: float = 1.0
) -> Path:
    """A COLMAP model in text. camera: the line after the number of all frames' camera, by default a pinhole for each.
    depth: of points before the first camera.  scale: of the model's unit, units per meter."""
    model = folder / place
    model.mkdir(parents=True, exist_ok=True)
    cameras = [camera] if camera else list(dict.fromkeys(map(_pinhole, scan.cameras)))
    (model / "cameras.txt").write_text("".join(f"{n} {line}\n" for n, line in enumerate(cameras, 1)))
    lines = []
    for i, own in enumerate(scan.cameras):
        write_image(folder / "images" / f"view{i}.png", scan.color[i])
        T = invert(scan.T_world_cam[i])
        quat = " ".join(map(str, rotations_to_quats(T[:3, :3])))
        number = 1 if camera else cameras.index(_pinhole(own)) + 1
        lines += [f"{i + 1} {quat} {' '.join(map(str, scale * T[:3, 3]))} {number} view{i}.png", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    points = np.random.default_rng(0).uniform((-1, -1, depth), (1, 1, depth), (200, 3)) * scale
    rows = [f"{n + 1} {p[0]} {p[1]} {p[2]} 9 9 9 0" for n, p in enumerate(points)]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return folder


def write_binary_model(folder: Path, scan: Scan) -> Path:
    """A COLMAP model as COLMAP itself stores it."""
    model = write_model(folder, scan) / "sparse" / "0"
    read = pycolmap.Reconstruction(str(model))
    for file in list(model.iterdir()):
        file.unlink()
    read.write_binary(str(model))
    return folder


def _pinhole(camera: Intrinsics) -> str:
    return f"PINHOLE {camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx + 0.5} {camera.cy + 0.5}"
