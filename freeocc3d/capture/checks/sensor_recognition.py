"""Recognizes a depth camera by its depth.

A triangulating sensor stores a disparity in fractions of a pixel, so its depths have steps that grow with the square of
the depth: 2.9 mm at 1 m for eighths of a pixel (Kinect v1, PrimeSense: focal length 580 pixels, baseline 7.5 cm), and
1.0 to 1.7 mm for the 32nd parts of RealSense D400. A time of flight has no steps but those of the stored unit, and
far less noise at a distance than a projected pattern.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ...core.depth_sensors import STEREO, STRUCTURED_LIGHT, TIME_OF_FLIGHT, DepthSensor
from ...core.errors import FrameError
from ...core.sampling import spread_evenly
from ..base import Capture
from ..images.depth_decoding import SATURATED

_SAMPLES = 5
_EDGES_M = np.array((1.2, 1.6, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0))
"""Limits of the ranges in which steps and noise are measured, meters. Nearer, steps are as small as the stored unit."""
_LEAST_OF_A_VALUE = 20
"""Pixels that hold each depth of a range, on average, or its gaps are only what no pixel happened to show."""
_LEAST_STEP = 2.5
"""Stored units in a step that is more than the rounding to them."""
_LEAST_RANGES, _SAME_STEPS = 2, 1.6
"""Ranges that must have steps, and the largest ratio of these, each over the squared depth."""
_COARSE_STEP = 2.2e-3
"""Step over squared depth, 1 / meters, between that of 32nd parts of a pixel and that of eighths."""
_LEAST_PIXELS, _FLAT = 2000, 0.05
"""Pixels for the noise of a range, and the largest difference of neighbors on one surface, as a share of the depth."""
_LITTLE_NOISE = 0.5
"""Noise over that of structured light, below which a sensor without steps is a time of flight. It was 0.3 in a scan by
a phone's LiDAR, and 1.0 in the rendered room, which has the noise of structured light without its steps."""


def recognize_sensor(capture: Capture) -> DepthSensor:
    """The sensor whose steps and noise the depth of some frames has; structured light if they do not tell."""
    images = list(_stored_depth(capture))
    if not images:
        return STRUCTURED_LIGHT
    values, counts = np.unique(np.concatenate([depth[depth > 0] for depth in images]), return_counts=True)
    if (step := measure_steps(values, counts)) is not None:
        return STRUCTURED_LIGHT if step > _COARSE_STEP else STEREO
    noise = measure_noise(images)
    return TIME_OF_FLIGHT if noise is not None and noise < _LITTLE_NOISE else STRUCTURED_LIGHT


def _stored_depth(capture: Capture) -> Iterator[NDArray[np.float64]]:
    """(H, W) depth of frames across the capture in meters, as stored; 0 = no measurement."""
    for index in spread_evenly(len(capture), _SAMPLES):
        try:
            stored = capture.raw_depth(index)
            depth_m = capture[index].depth_m.astype(np.float64) if stored is None else stored[0] / stored[1]
        except FrameError:
            continue
        whole = stored is not None and stored[0].dtype.kind == "u"
        wrong = stored[0] >= SATURATED if whole and stored is not None else ~np.isfinite(depth_m)
        yield np.where(wrong, 0.0, depth_m)


def measure_steps(values: NDArray[np.float64], counts: NDArray[np.int64]) -> float | None:
    """The step between depths over their square, 1 / meters; None if there are no such steps.

    values: (K,) ascending distinct depths, meters.  counts: (K,) pixels of each.
    """
    if len(values) < _LEAST_RANGES:
        return None
    unit = np.diff(values).min()
    steps = []
    for low, high in itertools.pairwise(_EDGES_M):
        there = (values >= low) & (values < high)
        if there.sum() < 3 or counts[there].mean() < _LEAST_OF_A_VALUE:
            continue
        own = values[there]
        if np.median(np.diff(own)) >= _LEAST_STEP * unit:
            steps.append(float(np.median(np.diff(own) / own[1:] ** 2)))
    alike = len(steps) >= _LEAST_RANGES and max(steps) <= _SAME_STEPS * min(steps)
    return float(np.median(steps)) if alike else None


def measure_noise(images: list[NDArray[np.float64]]) -> float | None:
    """The noise of (H, W) depth images, meters, over that of structured light; None if they show no surface beyond the
    nearest range. Measured by second differences along rows, whose variance is six times that of the depths."""
    depth, bend = [], []
    for image in images:
        left, middle, right = image[:, :-2], image[:, 1:-1], image[:, 2:]
        span = np.maximum(np.abs(left - middle), np.abs(right - middle))
        flat = (np.minimum(left, right) > 0) & (middle > 0) & (span < _FLAT * middle)
        depth.append(middle[flat])
        bend.append((left - 2 * middle + right)[flat])
    z, own = np.concatenate(depth), np.concatenate(bend) ** 2 / 6
    ratios = []
    for low, high in itertools.pairwise(_EDGES_M):
        there = (z >= low) & (z < high)
        if there.sum() >= _LEAST_PIXELS:
            usual = float(STRUCTURED_LIGHT.compute_sigma(0.5 * (low + high)))
            ratios.append(float(np.sqrt(own[there].mean())) / usual)
    return float(np.median(ratios)) if ratios else None
