"""Class images from the capture or from another program; words match class names and their synonyms."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from ...capture.base import Capture
from ...capture.class_files import read_class_names
from ...capture.files.numbered_files import list_folder
from ...core.errors import CaptureError
from ...core.image_files import ImageFileError, read_image
from ...core.typed_documents import as_type
from ...core.types import Frame
from ...settings.option_types import FilePath, Stride
from ...settings.typed_options import TypedOptions
from .. import class_names
from .base import Encoder, TextEncoder, TextFeatures

REQUIRES: tuple[str, ...] = ()

_VOID = 255
"""A value that means nothing in many class images, even if there are fewer than 255 classes."""
_MOST_CLASSES = 8192
"""The features of all classes, a table of classes x classes float16, then take 134 MB."""
_ASPECT_TOLERANCE = 0.02


class Options(TypedOptions, frozen=True):
    """The class images, if the capture has none."""

    folder: FilePath | None = None
    """Folder of class images, PNG with one channel. If their number equals that of the frames, they are used in order.
    Otherwise the last number in a file's name is the frame's index, from 0. null = use the capture's own."""
    classes: FilePath | None = None
    """File with the class names: JSON {"classes": [...]} or one name per line. The first (value 0) means nothing. null
    = classes.json or classes.txt in the folder, or the capture's own."""
    stride: Stride = 2
    """Use every n-th pixel of a class image."""


class LabelsEncoder(Encoder):
    """The feature of class k is the k-th unit vector; that of value 0 (nothing) is zero. The mean over views is the
    share of the views that saw the class, and the cosine with a class is high where they agree."""

    name: ClassVar[str] = "labels"

    def __init__(
        self, classes: tuple[str, ...], images: Callable[[int], NDArray[np.integer] | None], stride: int = 2
    ) -> None:
        if len(classes) > _MOST_CLASSES:
            raise CaptureError(f"The labels encoder knows at most {_MOST_CLASSES} classes, not {len(classes)}.")
        self.classes = classes
        self.images = images
        self.stride = stride
        self.dimension = len(classes) - 1
        self._features = np.zeros((len(classes), self.dimension), np.float16)
        self._features[np.arange(1, len(classes)), np.arange(self.dimension)] = 1.0

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(ceil(H / stride), ceil(W / stride), D) float16; one zero feature for a frame without a class image.

        A class image of another size is sampled at the corresponding pixels. Raises CaptureError for an image with
        another aspect ratio, or with a value that has no name.
        """
        labels = self.images(frame.index)
        if labels is None:
            return np.zeros((1, 1, self.dimension), np.float16)
        height, width = frame.color.shape[:2]
        if abs(labels.shape[1] * height / (labels.shape[0] * width) - 1) > _ASPECT_TOLERANCE:
            raise CaptureError(
                f"The class image of frame {frame.index} has {labels.shape[1]} x {labels.shape[0]} pixels, the frame "
                f"{width} x {height}. Their views differ: make the class image from the frame's own color image."
            )
        rows, columns = (
            _sampled(size, self.stride, own) for size, own in zip((height, width), labels.shape, strict=True)
        )
        sampled = labels[rows[:, None], columns].astype(np.int64)
        sampled[(sampled == _VOID) & (len(self.classes) <= _VOID)] = 0
        if sampled.max(initial=0) > self.dimension:
            raise CaptureError(
                f"The class image of frame {frame.index} has value {sampled.max()}, but only {len(self.classes)} "
                "classes have names: add the missing names to the list of classes."
            )
        return self._features[sampled]

    def text_state(self) -> dict[str, Any]:
        return {"classes": list(self.classes)}


class LabelState(msgspec.Struct):
    """What a map keeps of an encoder of classes. classes: their names."""

    classes: Annotated[list[str], msgspec.Meta(min_length=1, max_length=1 << 16)]


class LabelWords(TextEncoder):
    """Class names, their synonyms, and wider words that include several classes."""

    threshold = 0.5
    temperature = 0.1
    same_word = 0.05  # classes are orthogonal: any overlap means that one word includes the other

    def __init__(self, classes: list[str]):
        self.classes = classes
        shown = ", ".join(classes[1:13]) + (", …" if len(classes) > 13 else "")
        self.knows = f"the names of its classes and their synonyms ({shown})"

    def encode_words(self, words: list[str]) -> TextFeatures:
        features = np.zeros((len(words), len(self.classes) - 1), np.float32)
        attainable = np.ones(len(words), np.float32)
        understood, meant = [], []
        for row, word in enumerate(words):
            matched, part = self.matching(word)
            understood.append(part)
            meant.append(tuple(self.classes[1:][n] for n in matched))
            if matched:
                attainable[row] = 1.0 / np.sqrt(len(matched))
                features[row, matched] = attainable[row]
        return TextFeatures(features, tuple(understood), attainable, tuple(meant))

    def matching(self, word: str) -> tuple[list[int], str]:
        """The dimensions of the classes that a phrase means, and the part of the phrase that was used."""
        return class_names.match_names(word, self.classes[1:])

    def contrast_words(self) -> list[str]:
        return self.classes[1:]


def load(options: Options, capture: Capture) -> LabelsEncoder:
    """Makes the encoder. Raises CaptureError if there are no class images, or no names for them."""
    if options.folder is None:
        classes = read_class_names(Path(options.classes)) if options.classes else capture.classes
        if len(classes) < 2 or all(capture.labels(index) is None for index in range(min(len(capture), 10))):
            raise CaptureError(
                f"{capture.path} has no class images with names. Give them with language.labels.folder and "
                "language.labels.classes, or use another encoder, for example language.encoder=color."
            )
        return LabelsEncoder(tuple(classes), capture.labels, options.stride)
    folder = Path(options.folder)
    beside = next((folder / name for name in ("classes.json", "classes.txt") if (folder / name).is_file()), None)
    named = Path(options.classes) if options.classes else beside
    if named is None:
        raise CaptureError(
            f"The folder {folder} has no classes.json or classes.txt: add one, or set language.labels.classes to a "
            "file with the class names."
        )
    return LabelsEncoder(read_class_names(named), _FolderImages(folder, len(capture)), options.stride)


def load_text(state: dict[str, Any]) -> LabelWords:
    """Restores the text part. Raises ValueError for a state of another form."""
    return LabelWords(as_type(state, LabelState).classes)


def _sampled(size: int, stride: int, own_size: int) -> NDArray[np.int64]:
    """Pixels along an axis of a class image of ``own_size``, at the centers of blocks of ``stride`` pixels of
    ``size``."""
    count = -(-size // stride)
    return np.minimum(((np.arange(count) + 0.5) * own_size / count).astype(np.int64), own_size - 1)


class _FolderImages:
    """Class images in a folder, in the order of the last number in their names, or found by it."""

    def __init__(self, folder: Path, frames: int):
        names = [name for name in list_folder(folder) if name.endswith(".png")]
        paths = [folder / name for name in names if re.search(r"\d", name.removesuffix(".png"))]
        if not paths:
            raise CaptureError(f"The folder {folder} has no class images: *.png with the frame's number in the name.")
        numbered = {int(re.findall(r"\d+", path.stem)[-1]): path for path in paths}
        if len(numbered) < len(paths):
            raise CaptureError(f"Several class images in {folder} have the same number: keep one for each frame.")
        in_order = len(numbered) == frames
        self._paths = dict(enumerate(numbered[n] for n in sorted(numbered))) if in_order else numbered

    def __call__(self, index: int) -> NDArray[np.integer] | None:
        import cv2

        path = self._paths.get(index)
        if path is None:
            return None
        try:
            image = read_image(path, cv2.IMREAD_UNCHANGED)
        except ImageFileError as error:
            raise CaptureError(f"The class image cannot be used: {error}") from error
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
            raise CaptureError(f"{path} is not a class image: a class image is an 8- or 16-bit PNG with one channel.")
        return np.asarray(image)
