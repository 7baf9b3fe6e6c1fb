"""Reads a folder of photographs or video frames (jpg, heic, png, tif, …), in natural order of their names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError
from ...core.image_files import Size
from ...core.types import Frame, Intrinsics
from ...core.warnings import Notice
from ..base import Capture, Options
from ..cameras.camera_files import guess_camera, read_given_calibration, reduce_camera
from ..files.image_suffixes import COLOR_SUFFIXES, HEIF_SUFFIXES
from ..files.numbered_files import list_folder
from ..files.paired_folders import find_folders
from ..folder_contents import holds_depth_or_confidence
from ..image_headers import Header, find_common_lens, read_header
from ..images.heif_files import read_heif
from ..images.image_decoding import read_color

REQUIRES: tuple[str, ...] = ("PIL", "pillow_heif")

SUFFIXES = {*COLOR_SUFFIXES, *HEIF_SUFFIXES}
_ENDINGS = tuple(SUFFIXES)
UNREADABLE = {
    ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw", ".jxl", ".insp",
}  # fmt: skip
"""Image formats of phones and cameras that no decoder here reads."""


class Reader(Capture):
    """The images lie in the folder or in its ``images/``. The EXIF orientation is applied, and images are reduced to
    ``capture.max_size``. All images have one camera. Images with swapped width and height are turned by a quarter to
    the most common size (``turned``). Images of any other size or in a format of cameras that is not read, and HEIC
    images of which there is a JPEG, are left out with a warning. Frame numbers count the images that remain. Poses,
    pixels and pictures refer to the turned images.

    The camera is ``capture.intrinsics``, for the upright size before reduction. Otherwise it is a guess with the focal
    length in the EXIF data of most images (35 mm equivalent, or focal length and sensor resolution). This is accurate
    to a few percent, so ``focal_stated`` is true and ``intrinsics_known`` false. Timestamps come from EXIF if they
    ascend, else they are 0, 1, 2, ….
    """

    format = "photos"
    layout = "images (jpg, heic, png, tif, bmp, webp) by one camera"
    general = True
    has_depth = False

    def __init__(self, path: Path, options: Options):
        super().__init__(path, options)
        images, unreadable = _decodable(list_images(path))
        if len(images) < 2:
            raise CaptureError(_too_few(path, [image for image, _ in images]))
        left_out = _tell_unreadable(path, unreadable, len(images)) if unreadable else []
        self._size = _common_size(path, [header for _, header in images if header is not None])
        both = self._size, self._size[::-1]
        odd = [(image, header) for image, header in images if header is not None and header.size not in both]
        images = [(image, header) for image, header in images if header is None or header.size in both]
        self.warnings = (*left_out, *([_left_out(path, odd, len(images), self._size)] if odd else []))
        self._paths, headers = [image for image, _ in images], [header for _, header in images]
        self._headers = headers
        stated, lens = (
            read_given_calibration(options),
            find_common_lens([header for header in headers if header is not None], self._size),
        )
        camera = stated.camera(self._size) if stated else lens or guess_camera(self._size)
        self.intrinsics_known, self.focal_stated = stated is not None, stated is not None or lens is not None
        self.intrinsics: Intrinsics = reduce_camera(camera, options.max_size)
        self.timestamps = _times(headers)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        found = list_images(path)
        if not found:
            return bool(_unreadable(path))
        return find_folders(path) is None and holds_depth_or_confidence(found[0].parent) is None

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"Frame {index} of {len(self)} images.")
        path, header, camera = self._paths[index], self._headers[index], self.intrinsics
        stored = read_heif(path) if header and header.heif else read_color(path)
        color = apply_orientation(stored, header.orientation if header and not header.by_decoder else 1)
        color = np.ascontiguousarray(np.rot90(color, self.turned(index)))
        height, width = color.shape[:2]
        if (width, height) != self._size:
            raise FrameError(
                f"{path} has {width} x {height} pixels, but most other images have {self._size[0]} x {self._size[1]}."
            )
        if (width, height) != (camera.width, camera.height):
            color = cv2.resize(color, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        return Frame(index, float(self.timestamps[index]), color, np.zeros(color.shape[:2], np.float32), camera)

    def name(self, index: int) -> str:
        return self._paths[index].name

    def files(self, index: int) -> tuple[Path, ...]:
        return (self._paths[index],)

    def turned(self, index: int) -> int:
        header = self._headers[index]
        if header is None or header.size == self._size:
            return 0
        if header.orientation >= 5:  # back to the stored orientation, like the others
            return 1 if header.orientation in (5, 6) else -1
        # To portrait, as phones store it: the sensor's left edge becomes the top.
        return 1 if self._size[0] > self._size[1] or header.orientation in (3, 4) else -1


def list_images(folder: Path) -> list[Path]:
    """The images of a folder or, if it has none, of its ``images/``, in natural order: 2 before 10."""
    for place in (folder, folder / "images"):
        names = [name for name in list_folder(place) if name.lower().endswith(_ENDINGS)]
        if found := [place / name for name in names if not name.startswith(".")]:
            return sorted(found, key=make_natural_key)
    return []


def make_natural_key(path: Path) -> list[tuple[int, str]]:
    """Sort key that compares numbers in names as numbers, of any length."""
    parts = re.split(r"([0-9]+)", path.as_posix().lower())
    numbers = [part.lstrip("0") for part in parts[1::2]]
    keys = [(-1, part) for part in parts]
    keys[1::2] = [(len(number), number) for number in numbers]
    return keys


def apply_orientation(image: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Turn a stored image (H, W, 3) upright. orientation: EXIF's (CIPA DC-008, tag 274)."""
    if orientation >= 5:
        image = image.transpose(1, 0, 2)  # 5; the others are 5 and then 2, 3 or 4
    rows, columns = {2: (1, -1), 6: (1, -1), 3: (-1, -1), 7: (-1, -1), 4: (-1, 1), 8: (-1, 1)}.get(orientation, (1, 1))
    return np.ascontiguousarray(image[::rows, ::columns])


def _times(headers: Sequence[Header | None]) -> NDArray[np.float64]:
    """(N,) seconds since the first image if all images state ascending times; else 0, 1, 2, …."""
    stated = np.array([np.nan if header is None or header.time is None else header.time for header in headers])
    if np.isfinite(stated).all() and (np.diff(stated) > 0).all():
        return np.asarray(stated - stated[0])
    return np.arange(len(headers), dtype=np.float64)


def _common_size(folder: Path, headers: Sequence[Header]) -> Size:
    """The most common upright size; images with swapped width and height count too. Raises CaptureError if no image is
    readable, or no two have the same size."""
    if not headers:
        raise CaptureError(f"No image of {folder} can be read: all files are damaged, or are not images.")
    upright_sizes = Counter(header.size for header in headers)
    either = {
        size: count + (upright_sizes[size[::-1]] if size[0] != size[1] else 0) for size, count in upright_sizes.items()
    }
    size = max(upright_sizes, key=lambda size: (either[size], upright_sizes[size]))
    if either[size] < 2 <= len(headers):
        raise CaptureError(
            f"The {len(headers)} images of {folder} all have different sizes, but a scan needs one camera: give "
            "images of one size, as a camera stores them."
        )
    return size


def _left_out(folder: Path, odd: Sequence[tuple[Path, Header]], used: int, size: Size) -> Notice:
    (path, header), count = odd[0], len(odd)
    return Notice(
        "images-left-out",
        f"{count} of the {count + used} images of {folder} {'is' if count == 1 else 'are'} left out, first "
        f"{path.name} with {header.size[0]} x {header.size[1]} pixels: the others have {size[0]} x {size[1]}, and a "
        "scan needs images of one camera.",
    )


def _decodable(paths: Sequence[Path]) -> tuple[list[tuple[Path, Header | None]], list[Path]]:
    """The images with their headers, None for a damaged one; and those of cameras' formats that cannot be decoded, or
    that are there as JPEG too."""
    others = {path.stem.lower() for path in paths if path.suffix.lower() not in HEIF_SUFFIXES}
    images, unreadable = list[tuple[Path, Header | None]](), list[Path]()
    for path in paths:
        of_camera = path.suffix.lower() in HEIF_SUFFIXES
        header = None if of_camera and path.stem.lower() in others else read_header(path)
        if header is None and of_camera:
            unreadable.append(path)
        else:
            images.append((path, header))
    files = [paths[0].parent / name for name in list_folder(paths[0].parent)] if paths else []
    stems = {path.stem.lower() for path in paths}  # many cameras write a raw image beside each JPEG
    unreadable += [file for file in files if file.suffix.lower() in UNREADABLE and file.stem.lower() not in stems]
    return images, unreadable


def _tell_unreadable(folder: Path, files: Sequence[Path], used: int) -> list[Notice]:
    """A warning for each suffix of files that are left out."""
    by_suffix: dict[str, list[Path]] = {}
    for file in files:
        by_suffix.setdefault(file.suffix.lower(), []).append(file)
    total = used + len(files)
    return [
        Notice(
            "images-left-out",
            f"{len(of_suffix)} {suffix} ({suffix[1:].upper()}) of {total} images of {folder} "
            f"{'is' if len(of_suffix) == 1 else 'are'} left out, first {of_suffix[0].name}: they cannot be decoded, or "
            "there is a JPEG of the same name. Convert them to JPEG.",
        )
        for suffix, of_suffix in sorted(by_suffix.items())
    ]


def _too_few(path: Path, found: Sequence[Path]) -> str:
    if found:
        return f"{path} holds only one image, {found[0].name}: a scan needs many images of one place, from all sides."
    if raw := [*_unreadable(path), *list_images(path)]:
        return f"{path} holds {raw[0].name} and similar files, which cannot be decoded: convert them to JPEG."
    return f"{path} holds no images (jpg, heic, png, tif, bmp, webp)."


def _unreadable(path: Path) -> list[Path]:
    endings = tuple(UNREADABLE)
    places = (path, path / "images")
    return [place / name for place in places for name in list_folder(place) if name.lower().endswith(endings)]
