"""Converts COLMAP models, read or newly made, to reconstructions of a capture's frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePath

import numpy as np
import pycolmap

from ...capture.base import Capture
from ...capture.cameras.lenses import Lens
from ...capture.files.file_finding import last_part
from ...capture.poses.colmap_models import ColmapModel, ModelCamera, ModelImage, read_colmap_model
from ...capture.poses.colmap_projects import colmap_folder
from ...core.errors import CaptureError, TrackingError
from ...core.transforms import invert
from ...core.types import Intrinsics
from .reconstruction import Reconstruction


def read_model(folder: Path, capture: Capture) -> Reconstruction:
    """Read a COLMAP model (cameras, images and points3D, .bin or .txt) as a reconstruction of the capture's frames.
    Images match frames by file name, with or without suffix. The scale is unknown. Raises CaptureError for an
    unreadable model, TrackingError for a model of other images."""
    own_folder = colmap_folder(folder)
    if own_folder is None:
        raise CaptureError(
            f"{folder} holds no COLMAP model (tracking.colmap.model): expected cameras, images, points3D."
        )
    model = read_colmap_model(own_folder)
    names = [capture.name(index) for index in range(len(capture))]
    whole = {PurePath(name).name: index for index, name in enumerate(names) if name}
    stems = {PurePath(name).stem: index for index, name in enumerate(names) if name}

    def frame_of(name: str) -> int | None:
        own = PurePath(last_part(name))
        return whole.get(own.name, stems.get(own.stem))

    found = convert_model(model, len(capture), frame_of, str(folder))
    if not found.has_pose.any():
        first = next((image.name for image in model.images), "no image")
        raise TrackingError(
            f"No image of the model in {folder} belongs to a frame of {capture.path}: its first image is {first}, the "
            f"capture's {names[0] or 'has no name'}."
        )
    if not len(found.points):
        raise TrackingError(f"The model in {folder} holds no points that the capture's frames see: use another model.")
    size = capture[int(np.flatnonzero(found.has_pose)[0])].color.shape[1::-1]
    camera = found.lens.camera
    if (camera.width, camera.height) != size:
        raise TrackingError(
            f"The model in {folder} is for images of {camera.width} x {camera.height} pixels, but those of "
            f"{capture.path} have {size[0]} x {size[1]}: use the images that the model was made from."
        )
    return found


def plain_model(model: pycolmap.Reconstruction) -> ColmapModel:
    """A model in pycolmap's memory as plain data: the images that have a pose."""
    images = []
    for image in model.images.values():
        if not image.has_pose:
            continue
        T_cam_world = np.eye(4)
        T_cam_world[:3] = image.cam_from_world().matrix()
        seen = [point.point3D_id for point in image.get_observation_points2D()]  # pycolmap gives no array
        images.append(ModelImage(image.name, image.camera_id, T_cam_world, np.array(seen, np.uint64)))
    cameras = {
        number: ModelCamera(camera.model.name, camera.width, camera.height, tuple(camera.params.tolist()))
        for number, camera in model.cameras.items()
    }
    ids = np.array(sorted(model.points3D), np.uint64)
    points = np.array([model.points3D[int(i)].xyz for i in ids], np.float64).reshape(-1, 3)
    return ColmapModel(cameras, images, points, ids)


def convert_model(
    model: ColmapModel, frames: int, frame_of: Callable[[str], int | None], source: str
) -> Reconstruction:
    """Convert a model to a reconstruction of a capture's N ``frames``. frame_of: image name -> frame, or None.

    source: where the model comes from, for messages. Raises TrackingError for several cameras, CaptureError for an
    unsupported camera model.
    """
    T_world_cam = np.full((frames, 4, 4), np.nan)
    seen_frame, seen_id, cameras = [], [], set()
    for image in model.images:
        frame = frame_of(image.name)
        if frame is None:
            continue
        T_world_cam[frame] = invert(image.T_cam_world)
        seen_id.append(image.seen)
        seen_frame.append(np.full(len(image.seen), frame, np.int32))
        cameras.add(image.camera)
    lenses = {model.cameras[camera].lens(source) for camera in cameras} or {_NO_LENS}
    if len(lenses) > 1:
        raise TrackingError(
            f"The model has {len(lenses)} cameras, but a capture has one: make the model with one shared camera "
            "(COLMAP: --ImageReader.single_camera 1)."
        )
    observed = np.concatenate(seen_id) if seen_id else np.zeros(0, np.uint64)
    unique, seen_point = np.unique(observed, return_inverse=True)
    points = model.points[model.rows(unique)].astype(np.float32)
    return Reconstruction(
        T_world_cam,
        next(iter(lenses)),
        points,
        np.concatenate(seen_frame) if seen_frame else np.zeros(0, np.int32),
        seen_point.astype(np.int32),
        metric=False,
        apart=np.zeros(frames, bool),
        chosen=np.ones(frames, bool),
    )


_NO_LENS = Lens(Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0))
