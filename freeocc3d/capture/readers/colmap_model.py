"""Reads COLMAP project folders: images/ with an existing model in sparse/0, sparse, 0 or the folder itself."""

from __future__ import annotations

from pathlib import Path

from ...core.errors import CaptureError
from ...core.transforms import invert
from ..base import Options
from ..colmap_models import colmap_folder, read_colmap_model
from ..posed_images import PosedImage, PosedImages, compute_nominal_scale, resolve_inside
from .photos import make_natural_key

REQUIRES: tuple[str, ...] = ()


class Reader(PosedImages):
    """The registered images, in natural order of their names. There is no depth.

    The unit of the model is arbitrary. ``capture.scale`` gives meters per unit; without it, the scale gives the sparse
    points a median depth of ``NOMINAL_DEPTH``. Raises CaptureError for a damaged model or an unsupported camera.
    """

    format = "colmap_model"
    layout = "images/ with sparse/0/images.bin (or .txt)"

    def __init__(self, path: Path, options: Options):
        folder = colmap_folder(path)
        if folder is None:
            raise CaptureError(f"{path} holds no COLMAP model: expected {self.layout}.")
        model = read_colmap_model(folder)
        lenses = {number: camera.lens(str(folder)) for number, camera in model.cameras.items()}
        posed = []
        for image in model.images:
            file = resolve_inside(path / "images", image.name, folder)
            posed.append(PosedImage(file, None, lenses[image.camera], invert(image.T_cam_world)))
        posed.sort(key=lambda view: make_natural_key(view.image))
        super().__init__(path, options, posed, options.scale or compute_nominal_scale(posed, model.points))
        self.metric_poses = options.scale is not None

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        names_images = colmap_folder(path) is not None and (path / "images").is_dir()
        return names_images and not (path / "transforms.json").is_file()
