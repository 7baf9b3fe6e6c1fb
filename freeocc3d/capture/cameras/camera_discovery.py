"""Finds the cameras that files beside the images of a capture state, whatever the files are called."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...core.errors import CaptureError
from ...core.image_files import Size
from ..files.name_matching import match_names
from ..files.numbered_files import list_folder
from .camera_documents import MOST_BYTES, CameraDocument, StatedCamera, read_cameras
from .camera_files import same_view
from .lenses import Lens
from .rigs import StatedCameras

SAME_CAMERA = 0.01
"""Two statements of one camera agree if their parameters differ by less than this share of the image's width."""

FEWEST_OWN = 0.5
"""Files are those of single frames if more than this share of the color images has one."""

_SUFFIXES = {".json", ".yaml", ".yml", ".txt", ".csv"}
_SURE = re.compile(
    r"(?:.*[\W_])?(?:k|_?info|cam|camera|cam_?params?|camera_?params?|camera_?parameters|camera_?info|.*intrins.*|"
    r".*calib.*|.*camera_?matrix.*)(?:[\W_](?:color|colour|rgb|depth)(?:[\W_].*)?)?"
)
_NEVER = re.compile(r"extrin|pose|traj|groundtruth|imu|time|assoc|label|class|instance|semantic|transforms|pair")
_TEXT = re.compile(r"k|cam.*|.*intrin.*|.*calib.*|.*info|setting.*|sensor.*|param.*|scene\d{4}_\d\d")
_FOLDERS = re.compile(r"intrinsics?|calib(?:ration)?s?|cameras?|camera_?info|camera_?params?|config|params")
_MOST_FILES = 30


@dataclass(frozen=True)
class FoundCameras:
    """What files state about the cameras of a capture. units_per_meter: of stored depth, None = not stated."""

    stated: StatedCameras
    units_per_meter: float | None = None


def find_frame_files(folder: Path, color_names: Sequence[str]) -> dict[int, Path]:
    """The calibration files of single frames, such as ``calib/12.yaml`` of RTAB-Map: row of the color name -> file.
    Empty if no calibration folder has one for most of the color images."""
    for name in _calibration_folders(folder):
        files = [inner for inner in list_folder(folder / name) if inner.lower().endswith(tuple(_SUFFIXES))]
        found = match_names(color_names, files, by_time=False) if len(files) > 1 else None
        if found is not None and len(found.first) > FEWEST_OWN * len(color_names):
            return {row: folder / name / files[own] for row, own in zip(found.first, found.second, strict=True)}
    return {}


def find_cameras(folder: Path, color_size: Size, depth_size: Size | None, skipped: Path | None = None) -> FoundCameras:
    """The cameras of images of these sizes that files in the folder, its calibration folders or, failing that, its
    parent state. skipped: a calibration folder that holds files of single frames.

    Raises CaptureError: two files disagree, a file with the name of a calibration cannot be understood, or its camera
    cannot have taken the images.
    """
    for place in (folder, folder.absolute().parent):
        found = [document for file in _candidates(place, place is folder, skipped) if (document := _read(file))]
        if found:
            return _combine(found, color_size, depth_size)
    return FoundCameras(StatedCameras())


def _candidates(place: Path, own: bool, skipped: Path | None) -> Iterator[tuple[Path, bool]]:
    """Files that may state a camera, and whether their names say so. own: place is the capture's folder; in another,
    only names that say so count."""
    groups = [list_folder(place)]
    if own:
        folders = [name for name in _calibration_folders(place) if place / name != skipped]
        groups += [[f"{name}/{inner}" for inner in list_folder(place / name)] for name in folders]
    for group in groups:
        files = [place / name for name in group if name.lower().endswith(tuple(_SUFFIXES))]
        likely = [(file, sure) for file in files if (sure := _is_likely(file, own)) is not None]
        if len(likely) <= _MOST_FILES:  # more are those of each frame
            yield from likely


def _calibration_folders(folder: Path) -> list[str]:
    return [name for name in list_folder(folder) if _FOLDERS.fullmatch(name.lower())]


def _is_likely(file: Path, own: bool) -> bool | None:
    """Whether the name says that the file states a camera; None if the file cannot, or another folder's should not."""
    stem, suffix = file.stem.lower(), file.suffix.lower()
    if stem.startswith(".") or _NEVER.search(stem):
        return None
    sure = _SURE.fullmatch(stem) is not None
    if sure or not own:
        return sure or None
    return False if suffix in (".json", ".yaml", ".yml") or _TEXT.fullmatch(stem) else None


def _read(candidate: tuple[Path, bool]) -> tuple[Path, CameraDocument] | None:
    """The document of a candidate; None for other files. Raises CaptureError for a calibration that is not usable."""
    file, sure = candidate
    try:
        if not sure and (not file.is_file() or file.stat().st_size > MOST_BYTES):
            return None
        found = read_cameras(file)
    except CaptureError:
        if sure:
            raise
        return None
    except OSError as error:
        raise CaptureError(f"Cannot read {file}: {error.strerror}.") from error
    if found is None and sure and "intrin" in file.stem.lower():
        raise CaptureError(
            f"{file} states no camera that is understood: it must hold fx, fy, cx and cy, or a camera matrix of 3 x 3 "
            "numbers. Correct or remove it, or give capture.intrinsics."
        )
    return (file, found) if found else None


def _combine(found: list[tuple[Path, CameraDocument]], color_size: Size, depth_size: Size | None) -> FoundCameras:
    color = _agreed([(file, document.color) for file, document in found if document.color], color_size)
    depth = _agreed([(file, document.depth) for file, document in found if document.depth], depth_size or color_size)
    units = {document.units_per_meter: file for file, document in found if document.units_per_meter}
    if len(units) > 1:
        (a, first), (b, second) = list(units.items())[:2]
        raise CaptureError(
            f"{first} states {a:g} depth units per meter, but {second} states {b:g}: correct one, or give "
            "capture.depth_scale."
        )
    if color and not depth and depth_size and _is_of(color, depth_size) and not _is_of(color, color_size):
        color, depth = None, color
    T_color_depth = next((d.T_color_depth for _, d in found if d.T_color_depth is not None), None)
    return FoundCameras(
        StatedCameras(
            _lens(color, color_size), _lens(depth, depth_size) if depth_size else None, T_color_depth
        ),
        next(iter(units), None),
    )  # fmt: skip


def _lens(camera: StatedCamera | None, size: Size) -> Lens | None:
    return camera.lens(size) if camera else None


def _is_of(camera: StatedCamera, size: Size) -> bool:
    """Whether the camera states a size of the same view."""
    return camera.calibration.size is not None and same_view(camera.calibration.size, size)


def _agreed(stated: list[tuple[Path, StatedCamera]], size: Size) -> StatedCamera | None:
    """The one camera of several statements; that with a distortion, or else the first. Raises CaptureError if two
    disagree."""
    if not stated:
        return None
    (file, first), *others = stated
    for other_file, other in others:
        if not _same(first, other, size):
            raise CaptureError(
                f"{file} and {other_file} state different cameras: remove one, or give capture.intrinsics."
            )
    return next((camera for _, camera in stated if any(camera.distortion)), first)


def _same(a: StatedCamera, b: StatedCamera, size: Size) -> bool:
    def over_width(camera: StatedCamera) -> list[float]:
        width, height = camera.calibration.size or size
        fx, fy, cx, cy = camera.calibration.values
        cx, cy = (width - 1) / 2 if cx is None else cx, (height - 1) / 2 if cy is None else cy
        return [fx / width, fy / width, cx / width, cy / width]

    distortions = {camera.distortion for camera in (a, b) if any(camera.distortion)}
    return len(distortions) <= 1 and bool(np.abs(np.subtract(over_width(a), over_width(b))).max() < SAME_CAMERA)
