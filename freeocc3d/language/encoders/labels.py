"""Class images that the capture brings, or that another program made; words match class names and synonyms."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...capture.base import Capture
from ...errors import CaptureError, FrameError
from ...types import Frame
from .. import vocabulary
from .base import Encoder, TextEncoder, TextFeatures

REQUIRES: tuple[str, ...] = ()

_STEP = 2


@dataclass(frozen=True)
class Options:
    """Where the class images are, if the capture brings none."""

    folder: str | None = None
    """Folder of 8-bit class images; the last number in a file's name is the frame's. null = the capture's own."""
    classes: str | None = None
    """File with the class names: JSON {"classes": [...]} or one name a line; the first (value 0) means nothing."""


class LabelsEncoder(Encoder):
    """The feature of class k is the k-th unit vector, that of value 0 (nothing) is zero: the mean over views is the
    share of the views that saw the class, and the cosine with a class is high where they agree."""

    name: ClassVar[str] = "labels"

    def __init__(self, classes: tuple[str, ...], images: Callable[[int], NDArray[np.uint8] | None]):
        self.classes = classes
        self.images = images
        self.dimension = len(classes) - 1
        self._features = np.zeros((256, self.dimension), np.float16)
        self._features[np.arange(1, len(classes)), np.arange(self.dimension)] = 1.0

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        labels = self.images(frame.index)
        if labels is None:
            return np.zeros((1, 1, self.dimension), np.float16)
        if labels.max(initial=0) > self.dimension:
            raise CaptureError(f"The class image of frame {frame.index} has value {labels.max()}, which has no name.")
        return self._features[labels[_STEP // 2 :: _STEP, _STEP // 2 :: _STEP]]

    def text_state(self) -> dict[str, Any]:
        return {"classes": list(self.classes)}


class LabelWords(TextEncoder):
    """Class names, their synonyms, and wider words that include several classes."""

    threshold = 0.5
    temperature = 0.1

    def __init__(self, classes: list[str]):
        self.classes = classes

    def encode_words(self, words: list[str]) -> TextFeatures:
        features = np.zeros((len(words), len(self.classes) - 1), np.float32)
        understood = []
        for row, word in enumerate(words):
            matched, part = vocabulary.matching_names(word, self.classes[1:])
            features[row, matched] = 1.0 / np.sqrt(max(len(matched), 1))
            understood.append(part)
        return TextFeatures(features, tuple(understood))

    def contrast_words(self) -> list[str]:
        return self.classes[1:]


def load(options: Options, capture: Capture) -> LabelsEncoder:
    """The encoder. Raises CaptureError if there are no class images or no names for them."""
    if options.folder is None:
        classes = _read_classes(Path(options.classes)) if options.classes else capture.classes
        if not classes or capture.labels(0) is None:
            raise CaptureError(
                f"{capture.path} brings no class images with names: give them with language.labels.folder and "
                "language.labels.classes, or use another encoder."
            )
        return LabelsEncoder(tuple(classes), capture.labels)
    if options.classes is None:
        raise CaptureError("language.labels.folder needs language.labels.classes, a file with the classes' names.")
    return LabelsEncoder(_read_classes(Path(options.classes)), _FolderImages(Path(options.folder)))


def load_text(state: dict[str, Any]) -> LabelWords:
    """The word side."""
    return LabelWords([str(name) for name in state["classes"]])


def _read_classes(path: Path) -> tuple[str, ...]:
    """Names in a JSON document {"classes": [...]} or a list, or one a line."""
    try:
        text = path.read_text(encoding="utf-8")
        names = json.loads(text) if path.suffix == ".json" else [line for line in text.splitlines() if line.strip()]
        names = names["classes"] if isinstance(names, dict) else names
    except (OSError, ValueError, KeyError) as error:
        raise CaptureError(f"Cannot read the class names in {path}: {error}.") from error
    if not isinstance(names, list) or not 2 <= len(names) <= 256:
        raise CaptureError(f"{path} must name 2 to 256 classes, the first of which means nothing.")
    return tuple(str(name).strip() for name in names)


class _FolderImages:
    """Class images in a folder, found by the last number in their names."""

    def __init__(self, folder: Path):
        paths = [path for path in folder.glob("*.png") if re.search(r"\d", path.stem)] if folder.is_dir() else []
        self._paths = {int(re.findall(r"\d+", path.stem)[-1]): path for path in paths}
        if not self._paths:
            raise CaptureError(f"There are no class images (*.png with the frame's number in the name) in {folder}.")

    def __call__(self, index: int) -> NDArray[np.uint8] | None:
        import cv2

        path = self._paths.get(index)
        if path is None:
            return None
        image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None or image.ndim != 2 or image.dtype != np.uint8:
            raise FrameError(f"{path} is not an 8-bit class image with one channel.")
        return np.asarray(image)
