"""Reads COLMAP project folders: images with an existing model in sparse/0, sparse, colmap/sparse/0, dense/sparse, ….

Source: COLMAP's "Output Format" and "Tutorial" (the folders of a workspace).
"""

from __future__ import annotations

from pathlib import Path

from ...core.errors import CaptureError
from ...core.transforms import invert
from ..base import Options
from ..files.file_finding import FileFinder, report_missing
from ..posed_images import PosedImage, PosedImages, compute_nominal_scale
from ..poses.colmap_models import read_colmap_model
from ..poses.colmap_projects import IMAGES, find_colmap_project
from .photos import make_natural_key

REQUIRES: tuple[str, ...] = ()


class Reader(PosedImages):
    """The registered images, in natural order of their names. There is no depth. Of several models, that with the most
    images is read. Images whose files have other names are found where that is clear, else left out with a warning.

    The unit of the model is arbitrary. ``capture.scale`` gives meters per unit; without it, the scale gives the sparse
    points a median depth of ``NOMINAL_DEPTH``. Raises CaptureError for a damaged model, an unsupported camera, or a
    model of other images.
    """

    format = "colmap_model"
    layout = "images/ with sparse/0/images.bin (or .txt)"
    parts = ("images/*", "sparse/*")

    def __init__(self, path: Path, options: Options):
        project = find_colmap_project(path)
        if project is None:
            raise CaptureError(f"{path} holds no COLMAP model: expected {self.layout}.")
        model = read_colmap_model(project.model)
        lenses = {number: camera.lens(str(project.model)) for number, camera in model.cameras.items()}
        finder = FileFinder(project.images or path / IMAGES, "color")
        names = [image.name for image in model.images]
        files = finder.find_all(names)
        left_out = report_missing(names, files, finder, f"the model {project.model}")
        posed = [
            PosedImage(file, None, lenses[image.camera], invert(image.T_cam_world))
            for image, file in zip(model.images, files, strict=True)
            if file is not None
        ]
        posed.sort(key=lambda view: make_natural_key(view.image))
        super().__init__(path, options, posed, options.scale or compute_nominal_scale(posed, model.points))
        self.metric_poses = options.scale is not None
        self.warnings = (*project.notices(), *left_out)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        if (path / "transforms.json").is_file():
            return False
        project = find_colmap_project(path)
        return project is not None and project.images is not None
