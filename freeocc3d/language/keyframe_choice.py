"""Chooses the keyframes to encode if not all need to be: sharp ones that together show the most surface.

A greedy choice: the next keyframe is the one that adds most to

    sum_k log(1 + c W_k),   gain(t) = sharpness_t sum_k log((1 + c (W_k + w_t)) / (1 + c W_k)),

where W_k is the weight with which the chosen keyframes show Gaussian k (see ``visibility``), in units of its best view.
A Gaussian not yet seen counts most, then one that is seen badly or once. The gain of a keyframe only falls as more are
chosen. So a keyframe whose old gain is below another's new gain need not be computed again (lazy greedy: M. Minoux,
1978). If all are equally sharp, the choice is at least 1 - 1/e as good as the best choice of the same size.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .visibility import VisibleGaussians

_STEEP = 100.0
"""c: for a Gaussian that nothing else shows, a view a hundred times worse than the best is worth a seventh of it."""
_LEAST_SHARP = 0.05
"""Share of a blurred keyframe's gain that remains for what only it shows."""
_WIDTH = 320
"""Width at which sharpness is measured, small enough to average the sensor's noise."""


def measure_detail(color: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian over the variance of (H, W, 3) RGB: the share of fine detail, which motion blur and a
    lens out of focus reduce, and which brightness does not change. Without the division it is the measure of J.
    Pech-Pacheco et al., Diatom autofocusing in brightfield microscopy, ICPR 2000."""
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    if gray.shape[1] > _WIDTH:
        height = max(1, round(gray.shape[0] * _WIDTH / gray.shape[1]))
        gray = cv2.resize(gray, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var() / max(float(gray.var()), 1.0))


def choose_keyframes(
    views: Sequence[VisibleGaussians],
    sharp: Sequence[float],
    n_gaussians: int,
    most: int,
    coverage: float | None = None,
) -> list[int]:
    """Chooses up to ``most`` views, ascending; leaves out views that add nothing.

    sharp: the sharpness of each view.  coverage: a share of the Gaussians that the views show together; no more views
    are chosen once that share is shown. None = up to ``most`` anyway.
    """
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
    enough = np.inf if coverage is None else coverage * np.count_nonzero(best)
    while queue and len(chosen) < most and np.count_nonzero(so_far) < enough:
        _, row = heapq.heappop(queue)
        now = gain(row)
        if queue and -now > queue[0][0]:
            heapq.heappush(queue, (-now, row))
        elif now > 0:
            chosen.append(row)
            so_far[views[row].rows] += own[row]
    return sorted(chosen)
