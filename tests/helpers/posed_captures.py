"""Captures with poses from other programs: Nerfstudio's folders and COLMAP's models."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from small_captures import SIZE, camera_matrix, color_image, depth_image, pose_matrix, write_image

from freeocc3d.core.transforms import invert, rotations_to_quats

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(folder: Path, count: int, depth: bool = True, **more: Any) -> Path:
    """Frames of SIZE, listed in reverse."""
    K, frames = camera_matrix(), []
    for i in range(count):
        write_image(folder / "images" / f"frame_{i}.png", color_image(i))
        T = (pose_matrix(i) @ OPENGL).tolist()
        frames.append({"file_path": f"images/frame_{i}.png", "transform_matrix": T})
        if depth:
            write_image(folder / "depth" / f"frame_{i}.png", depth_image(i))
            frames[-1]["depth_file_path"] = f"depth/frame_{i}.png"
    camera = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5, "w": SIZE[0], "h": SIZE[1]}
    content = {"camera_model": "OPENCV", **camera, **more, "frames": frames[::-1]}
    folder.joinpath("transforms.json").write_text(json.dumps(content))
    return folder


def write_colmap(
    folder: Path, count: int, camera: str = "", place: str = "sparse/0", depth: float = 5.0, scale: float = 1.0
) -> Path:
    """camera: the line after the number, by default helpers' pinhole.  depth: of points before the first camera.
    scale: of the model's unit, units per meter."""
    model = folder / place
    model.mkdir(parents=True, exist_ok=True)
    K = camera_matrix()
    pinhole = f"PINHOLE {SIZE[0]} {SIZE[1]} {K[0, 0]} {K[1, 1]} {K[0, 2] + 0.5} {K[1, 2] + 0.5}"
    (model / "cameras.txt").write_text(f"1 {camera or pinhole}\n")
    lines = []
    for i in range(count):
        write_image(folder / "images" / f"view{i}.png", color_image(i))
        T = invert(pose_matrix(i))
        quat = " ".join(map(str, rotations_to_quats(T[:3, :3])))
        lines += [f"{i + 1} {quat} {' '.join(map(str, scale * T[:3, 3]))} 1 view{i}.png", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    points = np.random.default_rng(0).uniform((-1, -1, depth), (1, 1, depth), (200, 3)) * scale
    rows = [f"{n + 1} {p[0]} {p[1]} {p[2]} 9 9 9 0" for n, p in enumerate(points)]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return folder
