"""Tiny captures, written to a folder, and the folder of the large ones."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

SIZE = 32, 24
"""Width and height of the images that are written by default."""

DEPTH_M = 2.0
"""Depth of frame 0's pixels; frame i is a centimeter farther."""


def data_folder() -> Path:
    """The folder of large captures, or skip the test."""
    folder = Path(os.environ.get("FREEOCC3D_DATA") or Path(__file__).parents[3] / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no captures in {folder}: set FREEOCC3D_DATA to where they are")
    return folder


def models_folder() -> Path:
    """The folder of small real networks next to the captures, or skip the test."""
    folder = data_folder().parent / "models"
    if not folder.is_dir():
        pytest.skip(f"no networks in {folder}: they belong next to the captures, see FREEOCC3D_DATA")
    return folder


def color_image(index: int, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """(H, W, 3) RGB: red grows to the right, green downward, blue with the index."""
    width, height = size
    red, green = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.stack((red, green, np.full(red.shape, 10.0 * index % 256)), axis=-1).astype(np.uint8)


def depth_image(index: int, units_per_meter: float = 1000.0, size: tuple[int, int] = SIZE) -> NDArray[np.uint16]:
    """(H, W) depth as stored: a plane that faces the camera, with a left column that is not measured."""
    depth = np.full(size[::-1], round((DEPTH_M + 0.01 * index) * units_per_meter), np.uint16)
    depth[:, 0] = 0
    return depth


def pose_matrix(index: int) -> NDArray[np.float64]:
    """(4, 4) T_world_cam: a small turn about y, and a step of 5 cm along x, per frame."""
    angle = np.deg2rad(2.0 * index)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T_world_cam[0, 3] = 0.05 * index
    return T_world_cam


def camera_matrix(size: tuple[int, int] = SIZE) -> NDArray[np.float64]:
    """(3, 3) K of a camera that sees about 53° across images of ``size``."""
    width, height = size
    return np.array([[width, 0.0, (width - 1) / 2], [0.0, width, (height - 1) / 2], [0.0, 0.0, 1.0]])


def write_image(path: Path, image: NDArray[np.generic]) -> None:
    """Write RGB or gray in the format that the name states."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def write_matrix(path: Path, matrix: NDArray[np.float64]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix)


def write_seven_scenes(folder: Path, n: int, poses: bool = True, suffix: str = "png", first: int = 0) -> Path:
    """n frames of SIZE in 7-Scenes layout with a camera-intrinsics.txt."""
    write_matrix(folder / "camera-intrinsics.txt", camera_matrix())
    for i in range(n):
        name = f"frame-{first + i:06d}"
        write_image(folder / f"{name}.color.{suffix}", color_image(i))
        write_image(folder / f"{name}.depth.png", depth_image(i))
        if poses:
            write_matrix(folder / f"{name}.pose.txt", pose_matrix(i))
    return folder


def write_replica(
    folder: Path, n: int, scale: float = 6553.5, poses: bool = True, classes: bool = False, beside: bool = False
) -> Path:
    """n frames of SIZE in NICE-SLAM's Replica layout. classes: also class images with a left half of class 1 and a
    right half of class 2. beside: cam_params.json goes to the parent folder."""
    K = camera_matrix()
    camera = {"w": SIZE[0], "h": SIZE[1], "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "scale": scale}
    for i in range(n):
        write_image(folder / "results" / f"frame{i:06d}.png", color_image(i))
        write_image(folder / "results" / f"depth{i:06d}.png", depth_image(i, scale))
        if classes:
            write_image(folder / "semantic_class" / f"semantic_class_{i}.png", class_image())
    (folder.parent if beside else folder).joinpath("cam_params.json").write_text(json.dumps({"camera": camera}))
    if poses:
        write_matrix(folder / "traj.txt", np.array([pose_matrix(i).reshape(16) for i in range(n)]))
    if classes:
        (folder / "classes.json").write_text(json.dumps({"classes": ["nothing", "sofa", "lamp"]}))
    return folder


def class_image(size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """(H, W): left half 1, right half 2."""
    image = np.ones(size[::-1], np.uint8)
    image[:, size[0] // 2 :] = 2
    return image


def write_scannet(
    folder: Path, n: int, poses: bool = True, color_size: tuple[int, int] = SIZE, suffix: str = "png"
) -> Path:
    """n frames in ScanNet layout, numbered without padding; depth has SIZE."""
    for i in range(n):
        write_image(folder / "color" / f"{i}.{suffix}", color_image(i, color_size))
        write_image(folder / "depth" / f"{i}.png", depth_image(i))
        if poses:
            write_matrix(folder / "pose" / f"{i}.txt", pose_matrix(i))
    for kind, size in (("color", color_size), ("depth", SIZE)):
        K = np.eye(4)
        K[:3, :3] = camera_matrix(size)
        write_matrix(folder / "intrinsic" / f"intrinsic_{kind}.txt", K)
    return folder


def truncate(path: Path, share: float = 0.5) -> None:
    """Cut the end of a file off, as an interrupted copy does."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def thin_house(room: Path, folder: Path, step: int) -> Path:
    """Every ``step``-th frame of a room of the house, with its pose, classes and ground truth, in an empty folder of
    the room's name."""
    made = folder / room.parent.name / room.name
    for inner in ("results", "semantic_class"):
        (made / inner).mkdir(parents=True)
    poses = (room / "traj.txt").read_text().splitlines()[::step]
    (made / "traj.txt").write_text("\n".join(poses) + "\n")
    for name in ("cam_params.json", "classes.json", "ground_truth.npz"):
        (made / name).symlink_to(room / name)
    for n in range(len(poses)):
        for name in ("results/frame{:06d}.jpg", "results/depth{:06d}.png", "semantic_class/semantic_class_{:06d}.png"):
            (made / name.format(n)).symlink_to(room / name.format(n * step))
    return made
