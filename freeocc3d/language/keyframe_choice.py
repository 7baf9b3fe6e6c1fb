"""Which keyframes an encoder is given, when it may not have all: sharp ones that together show the most surface.

Greedily, the next keyframe is the one that adds most to

    sum_k log(1 + c W_k),   gain(t) = sharpness_t sum_k log((1 + c (W_k + w_t)) / (1 + c W_k)),

W_k being the weight with which the keyframes chosen so far show Gaussian k (see ``visibility``), in units of its best
view: what is not seen yet counts most, then what is seen badly or once. Such a gain only falls as more is chosen, so
that a keyframe whose old gain is below another's new one need not be looked at again (lazy greedy: M. Minoux, 1978).
Where all are equally sharp, what is chosen is at least 1 - 1/e as good as the best choice of as many.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .visibility import VisibleGaussians

_STEEP = 100.0
"""c: a view a hundred times worse than the best one is worth a seventh of it, for what nothing else shows."""
_LEAST_SHARP = 0.05
"""Of a blurred keyframe's gain, for what only it shows."""
_WIDTH = 320
"""Columns at which sharpness is measured, where the sensor's noise is averaged out."""


def measure_detail(color: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian over the variance of (H, W, 3) RGB: the share of fine detail, which motion and a lens
    out of focus take away, and which brightness does not change. Without the division it is the measure of J.
    Pech-Pacheco et al., Diatom autofocusing in brightfield microscopy, ICPR 2000."""
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    if grey.shape[1] > _WIDTH:
        height = max(1, round(grey.shape[0] * _WIDTH / grey.shape[1]))
        grey = cv2.resize(grey, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var() / max(float(grey.var()), 1.0))


def choose_keyframes(
    views: Sequence[VisibleGaussians], sharp: Sequence[float], n_gaussians: int, most: int
) -> list[int]:
    """At most ``most`` of some views, ascending; those that add nothing are left out. sharp: how sharp each is."""
    best = np.zeros(n_gaussians, np.float32)
    for view in views:
        best[view.rows] = np.maximum(best[view.rows], view.weights)
    so_far = np.zeros(n_gaussians, np.float32)  # c W_k
    own = [np.float32(_STEEP) * view.weights / best[view.rows] for view in views]
    usual = max(float(np.median(sharp)), 1e-9) if len(views) else 1.0
    factor = np.clip(np.asarray(sharp) / usual, _LEAST_SHARP, 1.0)

    def gain(row: int) -> float:
        return float(factor[row] * np.log1p(own[row] / (1 + so_far[views[row].rows])).sum())

    queue = [(-gain(row), row) for row in range(len(views))]
    heapq.heapify(queue)
    chosen: list[int] = []
    while queue and len(chosen) < most:
        _, row = heapq.heappop(queue)
        now = gain(row)
        if queue and -now > queue[0][0]:
            heapq.heappush(queue, (-now, row))
        elif now > 0:
            chosen.append(row)
            so_far[views[row].rows] += own[row]
    return sorted(chosen)
