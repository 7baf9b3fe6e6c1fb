"""COLMAP project folders: images/ with a model in sparse/0, sparse or the folder itself, instead of running COLMAP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import CaptureError
from ...core.transforms import invert
from ...core.types import Intrinsics
from ..base import Options
from ..posed_images import PosedImage, PosedImages, inside, nominal_scale
from ..trajectory_files import colmap_folder, read_colmap_model
from ..undistortion import Lens
from .photos import natural

REQUIRES: tuple[str, ...] = ("pycolmap",)


class Reader(PosedImages):
    """The registered images, in the natural order of their names. There is no depth.

    The model's unit is arbitrary: ``capture.scale`` says how many metres it is; without it, the model is scaled such
    that the sparse points have a median depth of ``NOMINAL_DEPTH``. Raises CaptureError: a damaged model, a camera that
    cannot be undistorted.
    """

    format = "colmap_model"
    layout = "images/ with sparse/0/images.bin (or .txt)"

    def __init__(self, path: Path, options: Options):
        folder = colmap_folder(path)
        if folder is None:
            raise CaptureError(f"{path} holds no COLMAP model: {self.layout}.")
        model = read_colmap_model(folder)
        lenses = {number: _lens(camera, folder) for number, camera in model.cameras.items()}
        posed = []
        for image in model.images.values():
            if image.has_pose:
                T_cam_world = np.eye(4)
                T_cam_world[:3] = image.cam_from_world().matrix()
                file = inside(path / "images", image.name, folder)
                posed.append(PosedImage(file, None, lenses[image.camera_id], invert(T_cam_world)))
        posed.sort(key=lambda view: natural(view.image))
        points = np.array([point.xyz for point in model.points3D.values()], np.float64).reshape(-1, 3)
        super().__init__(path, options, posed, options.scale or nominal_scale(posed, points))
        self.metric_poses = options.scale is not None

    @classmethod
    def recognises(cls, path: Path) -> bool:
        names_images = colmap_folder(path) is not None and (path / "images").is_dir()
        return names_images and not (path / "transforms.json").is_file()


def _lens(camera: Any, folder: Path) -> Lens:
    """Source: COLMAP's "Camera models", whose radial ones are OpenCV's. Pixel coordinates have their origin at the
    corner of the first pixel. Raises CaptureError."""
    values = dict(zip(_names(camera), np.asarray(camera.params, np.float64).tolist(), strict=True))
    fx = values.get("fx", values.get("f", 0.0))
    fy = values.get("fy", fx)
    intrinsics = Intrinsics(camera.width, camera.height, fx, fy, values["cx"] - 0.5, values["cy"] - 0.5)
    model = camera.model.name
    radial = tuple(values.get(name, values.get("k", 0.0) if name == "k1" else 0.0) for name in ("k1", "k2"))
    if model in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"):
        return Lens(intrinsics, (*radial, values.get("p1", 0.0), values.get("p2", 0.0)))
    if model == "FULL_OPENCV":
        return Lens(intrinsics, tuple(values[n] for n in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")))
    if model in ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        return Lens(intrinsics, (*radial, values.get("k3", 0.0), values.get("k4", 0.0)), fisheye=True)
    raise CaptureError(
        f"{folder} holds a camera of the model {model}, which is not read: undistort the images first (colmap "
        "image_undistorter)."
    )


def _names(camera: Any) -> list[str]:
    return [name.strip() for name in camera.params_info.split(",")]
