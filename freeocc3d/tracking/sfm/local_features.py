"""Finds local features of an image, keypoints and descriptors, by SIFT or a network.

Sources: D. Lowe, Distinctive Image Features from Scale-Invariant Keypoints, IJCV 2004, as in COLMAP;
R. Arandjelović, A. Zisserman, Three Things Everyone Should Know to Improve Object Retrieval, CVPR 2012.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import ModelError
from ...core.onnx_session import load_network

SIFT = "sift"

_COUNT = 6000
_SHRINK_TO = 1600  # pixels of the longer side: more cost more than they help
_GRAY, _COLOR = 1, 3


@dataclass(frozen=True)
class LocalFeatures:
    """The features of an image. pixels: (N, 2) float32; integers are pixel centers.  descriptors: (N, D), uint8 of norm
    512 (SIFT) or float32 of norm 1."""

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8] | NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.pixels)


class Detector(Protocol):
    """Finds features in (H, W, 3) uint8 RGB. ratio: largest ratio of the distances to the nearest and the second
    nearest for an unambiguous match; 1 = mutual nearest neighbors suffice."""

    ratio: float

    def __call__(self, color: NDArray[np.uint8]) -> LocalFeatures: ...


def load_detector(name: str) -> Detector:
    """Load a detector: ``"sift"``, or the path of an ONNX network. Raises ModelError."""
    return Sift() if name == SIFT else KeypointNetwork(Path(name).expanduser())


class Sift:
    """SIFT, as in COLMAP. Thread-safe."""

    ratio = 0.8

    def __init__(self) -> None:
        self._local = threading.local()

    def __call__(self, color: NDArray[np.uint8]) -> LocalFeatures:
        gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        shrink = max(max(gray.shape) / _SHRINK_TO, 1.0)
        if shrink > 1:
            gray = cv2.resize(gray, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
        if not hasattr(self._local, "extractor"):
            self._local.extractor = _sift()
        keypoints, descriptors = self._local.extractor.extract_from_uint8_array(gray)
        pixels = np.array([(point.x, point.y) for point in keypoints], np.float32).reshape(-1, 2)
        return LocalFeatures(pixels * np.float32(shrink) - np.float32(0.5), np.array(descriptors.data))


def _sift() -> Any:
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.sift.max_num_features = _COUNT
    return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


class KeypointNetwork:
    """A network that finds and describes keypoints, such as an export of SuperPoint, DISK or ALIKED.

    Input: (1, 1 or 3, H, W) float32 in 0…1. Outputs: one with "keypoint" in its name, (1, N, 2) or (N, 2) pixels x, y,
    and one with "descriptor" in its name, (1, N, D), (N, D) or (1, D, N). Raises ModelError.
    """

    ratio = 1.0

    def __init__(self, path: Path):
        if not path.is_file():
            raise ModelError(f"There is no network {path}: set tracking.colmap.features to sift, or to an .onnx file.")
        self._network = load_network(path)
        self._path = path
        inputs, outputs = list(self._network.inputs.items()), list(self._network.outputs)
        self._named = [next((n for n in outputs if kind in n.lower()), "") for kind in ("keypoint", "descriptor")]
        shape = inputs[0][1] if len(inputs) == 1 else []
        if len(shape) != 4 or shape[1] not in (_GRAY, _COLOR) or "" in self._named:
            raise ModelError(
                f"{path} is not a network for local features: it must take one image (1, 1 or 3, H, W) and give "
                f"keypoints and descriptors, but takes {[name for name, _ in inputs]} and gives {outputs}."
            )
        self._input, self._channels = inputs[0][0], shape[1]
        self._size = tuple(side if isinstance(side, int) else None for side in shape[2:])

    def __call__(self, color: NDArray[np.uint8]) -> LocalFeatures:
        image = color if self._channels == _COLOR else cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)[:, :, None]
        height, width = (own or given for own, given in zip(self._size, image.shape[:2], strict=True))
        shrunk = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).reshape(height, width, -1)
        tensor = np.ascontiguousarray(shrunk.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
        keypoints, descriptors = self._network.run(self._named, {self._input: tensor})
        flat = min(keypoints.ndim, descriptors.ndim) < 2
        if flat or keypoints.shape[-1] < 2 or max(descriptors.shape[:-2], default=1) > 1:
            raise ModelError(f"{self._path} gives keypoints {keypoints.shape} and descriptors {descriptors.shape}.")
        pixels = np.asarray(keypoints, np.float32).reshape(-1, keypoints.shape[-1])[:, :2]
        found = np.asarray(descriptors, np.float32).reshape(descriptors.shape[-2:])
        if len(found) != len(pixels):
            found = found.T
        if len(found) != len(pixels) or not (np.isfinite(found).all() and np.isfinite(pixels).all()):
            raise ModelError(
                f"{self._path} gives unusable features: keypoints {keypoints.shape} and descriptors "
                f"{descriptors.shape} do not match, or are not finite."
            )
        scale = np.array(color.shape[1::-1], np.float32) / np.array((width, height), np.float32)
        norm = np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-9)
        placed = (pixels + np.float32(0.5)) * scale - np.float32(0.5)
        return LocalFeatures(np.asarray(placed, np.float32), np.asarray(found / norm, np.float32))
