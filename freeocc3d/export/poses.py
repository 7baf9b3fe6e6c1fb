"""Keyframes with poses, for COLMAP and nerfstudio: a folder that Gaussian splatting and NeRF trainers read.

    colmap       FOLDER/sparse/0/{cameras,images,points3D}.txt and FOLDER/images/
    nerfstudio   FOLDER/transforms.json, sparse_pc.ply and FOLDER/images/

Points are the Gaussians' means. Source: COLMAP's "Output format", nerfstudio's "Data conventions".
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ..core.errors import ExportError
from ..core.transforms import invert, rotations_to_quats, transform
from ..core.types import Gaussians, Intrinsics
from ..query.scan_map import Map
from ..settings.typed_options import TypedOptions
from .export_frames import Frame, to_frame, write_description
from .ply import write_colored_ply

REQUIRES: tuple[str, ...] = ()

Views = list[tuple[Path, Intrinsics]]


class Options(TypedOptions, frozen=True):
    """Layout, frame, points."""

    form: Literal["colmap", "nerfstudio"] = "colmap"
    """"colmap" or "nerfstudio"."""
    frame: Frame = "gravity"
    """"gravity" (z up, floor at 0), "map", "start" (z up, first camera at the origin) or "first-camera" (its own)."""
    points: Annotated[int, Meta(ge=0, le=100_000_000)] = 100_000
    """Greatest number of points for the start of training: evenly spread means of Gaussians."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Writes the folder. Raises ExportError for a map without keyframes, MapError for a missing image."""
    views = scan_map.keyframes.views()
    T_frame_map = to_frame(scan_map, options.frame)
    T_frame_cam = T_frame_map @ scan_map.trajectory.T_world_keyframe
    if not views:
        raise ExportError("The map has no keyframes to write.")
    gaussians = scan_map.gaussians
    chosen = gaussians[:: max(1, -(-len(gaussians) // options.points))] if options.points else gaussians[:0]
    points = transform(T_frame_map, chosen.means.astype(np.float64))
    (path / "images").mkdir(parents=True)
    for image, _ in views:
        shutil.copyfile(image, path / "images" / image.name)
    form = _write_colmap if options.form == "colmap" else _write_nerfstudio
    form(path, views, T_frame_cam, points, chosen)
    told = {"metric": scan_map.metric}
    write_description(path / "frame", {"frame": options.frame, "T_frame_map": T_frame_map.tolist(), **told})


def _write_colmap(
    path: Path, views: Views, T_frame_cam: NDArray[np.float64], points: NDArray[np.float64], gaussians: Gaussians
) -> None:
    """Writes world-to-camera poses. Pixel coordinates start at the corner of the first pixel."""
    folder = path / "sparse" / "0"
    folder.mkdir(parents=True)
    numbers: dict[Intrinsics, int] = {}
    cameras, images = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"], ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"]
    T_cam_frame = invert(T_frame_cam)
    quats_wxyz = rotations_to_quats(T_cam_frame[:, :3, :3])
    for row, (image, camera) in enumerate(views):
        if camera not in numbers:
            numbers[camera] = len(numbers) + 1
            values = camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5
            cameras.append(f"{numbers[camera]} PINHOLE {camera.width} {camera.height} {_numbers(values)}")
        pose = _numbers((*quats_wxyz[row], *T_cam_frame[row, :3, 3]))
        images += [f"{row + 1} {pose} {numbers[camera]} {image.name}", ""]
    (folder / "cameras.txt").write_text("\n".join(cameras) + "\n", encoding="utf-8")
    (folder / "images.txt").write_text("\n".join(images) + "\n", encoding="utf-8")
    table = np.column_stack((np.arange(1, len(points) + 1), points, gaussians.colors, np.zeros(len(points))))
    header = "POINT3D_ID X Y Z R G B ERROR TRACK[]"
    np.savetxt(folder / "points3D.txt", table, "%d %.6f %.6f %.6f %d %d %d %d", header=header)


def _write_nerfstudio(
    path: Path, views: Views, T_frame_cam: NDArray[np.float64], points: NDArray[np.float64], gaussians: Gaussians
) -> None:
    """Writes camera-to-world poses of OpenGL cameras: view along -z, y up."""
    frames: list[dict[str, Any]] = []
    for (image, camera), T in zip(views, T_frame_cam * (1, -1, -1, 1), strict=True):
        frames.append(
            {
                "file_path": f"images/{image.name}", "w": camera.width, "h": camera.height, "fl_x": camera.fx,
                "fl_y": camera.fy, "cx": camera.cx + 0.5, "cy": camera.cy + 0.5, "transform_matrix": T.tolist(),
            }
        )  # fmt: skip
    write_colored_ply(path / "sparse_pc.ply", points.astype(np.float32), gaussians.colors)
    told = {"camera_model": "OPENCV", "ply_file_path": "sparse_pc.ply", "frames": frames}
    (path / "transforms.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{float(value):.12g}" for value in values)
