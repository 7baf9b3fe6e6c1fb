"""Which keyframes an encoder is given, when it may not have all: sharp ones that together show the most surface.

Greedily, the next keyframe is the one that adds most,

    gain(t) = sharpness_t sum_k min(w_t, (W_k - W'_k)+),

each in units of Gaussian k's best view: W'_k is the weight with which the keyframes chosen so far show it (see
``visibility``), and W_k what is enough, ``_ENOUGH`` such views. Such a gain only falls as more is chosen, so that a
keyframe whose old gain is below another's new one need not be looked at again (lazy greedy: M. Minoux, 1978); what is
chosen is at least 1 - 1/e as good as the best choice of as many.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .visibility import Seen

_ENOUGH = 4.0
"""Views as good as its best one, after which a Gaussian asks for no more."""
_WIDTH = 320
"""Columns at which sharpness is measured, where the sensor's noise is averaged out."""


def sharpness(color: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian over the variance of (H, W, 3) RGB: the share of fine detail, which motion and a lens
    out of focus take away, and which brightness does not change. Without the division it is the measure of J.
    Pech-Pacheco et al., Diatom autofocusing in brightfield microscopy, ICPR 2000."""
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    if grey.shape[1] > _WIDTH:
        height = max(1, round(grey.shape[0] * _WIDTH / grey.shape[1]))
        grey = cv2.resize(grey, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var() / max(float(grey.var()), 1.0))


def choose(views: Sequence[Seen], sharp: Sequence[float], n_gaussians: int, most: int) -> list[int]:
    """At most ``most`` of some views, ascending; those that add nothing are left out. sharp: how sharp each is."""
    best = np.zeros(n_gaussians, np.float32)
    for view in views:
        best[view.rows] = np.maximum(best[view.rows], view.weights)
    missing = np.float32(_ENOUGH) * best
    scale = max(float(np.median(sharp)), 1e-9) if len(views) else 1.0

    def gain(row: int) -> float:
        view = views[row]
        # Weights of near and far surface differ by orders of magnitude: each Gaussian counts in its own unit.
        shares = np.minimum(view.weights, missing[view.rows]) / best[view.rows]
        return min(sharp[row] / scale, 1.0) * float(shares.sum())

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
            missing[views[row].rows] = np.maximum(missing[views[row].rows] - views[row].weights, 0)
    return sorted(chosen)
