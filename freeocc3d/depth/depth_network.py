"""Runs a monocular depth network (ONNX), which predicts depth or inverse depth from one image. Fuses it with stereo.

Such a prediction is correct up to a scale and a shift of inverse depth (R. Ranftl et al., Towards Robust Monocular
Depth Estimation, PAMI 2022). The stereo depth of each frame determines both.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.depth_noise import MAD_TO_SIGMA
from ..core.errors import ModelError
from ..core.onnx_session import Network, load_network

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, the training data of the encoders
_FREE_SIZE, _PATCH = 518, 14
"""Pixels on the longer side of an input of free size, and of a patch: those of DINOv2, the base of Depth Anything."""

_LEAST_PIXELS = 200  # smallest number of pixels with a depth from stereo for the fit
_ROUNDS = 5  # fits, each without the outliers of the one before
_OUTLIERS = 2.5  # robust standard deviations
_BEYOND = 1.5  # a prediction counts up to this many times the largest inverse depth from stereo, and down to 1 / this
_NEAREST_M = 1e-3  # avoids division by a depth of 0
_TINY = 1e-9  # 1 / meters: avoids division by a standard deviation of 0
_LEAST_RELATIVE = 0.02  # smallest relative standard deviation of a predicted inverse depth
_METRIC = {"depth": True, "inverse": False}


class DepthNetwork:
    """Calls the network. Its metadata ``output`` is "inverse" (the default) or "depth"."""

    def __init__(self, network: Network):
        path, inputs, self._network = network.path, list(network.inputs.items()), network
        if len(inputs) != 1 or len(inputs[0][1]) != 4 or inputs[0][1][1] != 3 or not network.outputs:
            raise ModelError(f"{path} is not a depth network: it must take one image, (1, 3, H, W).")
        self._path, (self._input, self._shape) = path, inputs[0]
        self._output = next(iter(network.outputs))
        said = network.session.get_modelmeta().custom_metadata_map.get("output", "inverse")
        if said not in _METRIC:
            raise ModelError(f"{path}: the metadata 'output' must be inverse or depth, not {said}.")
        self._is_depth = _METRIC[said]

    def __call__(self, color: NDArray[np.uint8], width: int, height: int) -> NDArray[np.float32]:
        """(height, width) inverse depth without a unit, from (H, W, 3) uint8 RGB. Raises ModelError."""
        rows, columns = self._size(color)
        image = cv2.resize(color, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
        image = (image - np.array(_MEAN, np.float32)) / np.array(_DEVIATION, np.float32)
        (output,) = self._network.run([self._output], {self._input: image.transpose(2, 0, 1)[None]}, finite=False)
        found = np.asarray(output, np.float32)
        found = (
            found.reshape(found.shape[-2:]) if found.ndim >= 2 and found.size == np.prod(found.shape[-2:]) else found
        )
        if found.ndim != 2 or not found.size or not np.isfinite(found).all():
            raise ModelError(
                f"{self._path} is not a depth network: its output of shape {output.shape} is not a depth map."
            )
        inverse = 1.0 / np.maximum(found, _NEAREST_M) if self._is_depth else found
        return np.asarray(cv2.resize(inverse, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)

    def _size(self, color: NDArray[np.uint8]) -> tuple[int, int]:
        """Rows and columns of the input: fixed by the network, else multiples of a vision transformer's patch."""
        rows, columns = self._shape[2:]
        if isinstance(rows, int) and isinstance(columns, int):
            return rows, columns
        by = _FREE_SIZE / max(color.shape[:2])
        tall, wide = (max(_PATCH, _PATCH * round(side * by / _PATCH)) for side in color.shape[:2])
        return (rows if isinstance(rows, int) else tall), (columns if isinstance(columns, int) else wide)


def load_depth_network(path: Path, device: str = "cpu") -> DepthNetwork:
    """Load the network in an ONNX file. Raises ModelError, ConfigError."""
    return DepthNetwork(load_network(path, device))


def fuse_guess(
    inverse: NDArray[np.float32], sigma: NDArray[np.float32], guess: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fuse stereo's inverse depth and sigma with a network's prediction, weighted by inverse variance. The prediction
    alone fills pixels without stereo. All are (H, W). A frame with too little stereo depth to fit the prediction stays
    unchanged."""
    known = inverse > 0
    if np.count_nonzero(known) < _LEAST_PIXELS:
        return inverse, sigma
    x, y = guess[known].astype(np.float64), inverse[known].astype(np.float64)
    rows, inside = np.stack((x, np.ones_like(x)), axis=1), np.ones(len(x), bool)
    for _ in range(_ROUNDS):
        fit = np.linalg.lstsq(rows[inside], y[inside], rcond=None)[0]
        off = np.abs(rows @ fit - y)
        deviation = MAD_TO_SIGMA * float(np.median(off))
        inside = off <= max(_OUTLIERS * deviation, _TINY)
    if fit[0] <= 0:
        return inverse, sigma
    placed = np.asarray(fit[0] * guess + fit[1], np.float32)
    nearest, farthest = y.max() * _BEYOND, y.min() / _BEYOND
    usable = (placed > farthest) & (placed < nearest)
    spread = np.sqrt(deviation**2 + (_LEAST_RELATIVE * placed) ** 2).astype(np.float32)
    own = np.where(known, 1.0 / np.maximum(sigma, _TINY) ** 2, 0.0)
    theirs = np.where(usable, 1.0 / spread**2, 0.0)
    total = own + theirs
    mean = np.divide(own * inverse + theirs * placed, total, out=np.zeros_like(total), where=total > 0)
    deviation_of_mean = np.divide(1.0, np.sqrt(total), out=np.zeros_like(total), where=total > 0)
    return mean.astype(np.float32), deviation_of_mean.astype(np.float32)
