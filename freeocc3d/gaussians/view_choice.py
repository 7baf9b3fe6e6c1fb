"""Chooses the views to fit Gaussians to: few that together show every Gaussian several times.

Keyframes overlap: where a scan lingers, dozens show the same surface, and most add nothing. A greedy multiple cover:
the next view is the one that shows most Gaussians that fewer than ``TIMES`` of the chosen views show. So the number of
views grows with the surface, not with the frames.

Source: V. Vazirani, Approximation Algorithms, Springer 2001, Sec. 13.2 (set multicover).
"""

from __future__ import annotations

import functools
import heapq
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.threads import count_threads
from ..core.types import Gaussians
from .rasterizers.base import ALPHA_MIN, NEAR
from .rendered_views import CapturedView

TIMES = 8
"""Views that are to show each Gaussian. On house/bedroom, 3 lose 1 dB on other views; all, which show most Gaussians a
dozen times, gain 0.1 dB."""

_WORTH = 0.05
"""A view is chosen while it adds at least this share of what it shows."""

_WITHIN_M, _WITHIN_SHARE = 0.05, 0.02
"""A view shows a Gaussian if its depth there differs by less than the first, meters, plus the second times the depth:
the noise of a sensor, and about half the spacing of Gaussians."""

_BEHIND_M = 0.3
"""Meters behind the measured surface from which a Gaussian counts as hidden: farther than surfaces are thick."""
_AROUND = 0.04
"""Share of the image's width around a mean within which nothing may show it: about three standard deviations of a
Gaussian of usual size at usual depth."""

_REACH = math.sqrt(-2 * math.log(ALPHA_MIN))
"""Standard deviations at which even an opaque Gaussian is not drawn any more."""


def choose_views(gaussians: Gaussians, views: Sequence[CapturedView]) -> list[int]:
    """Rows of the chosen views, ascending; of views with any measured depth, at least one."""
    with ThreadPoolExecutor(count_threads()) as pool:
        shown = list(pool.map(lambda view: find_shown(gaussians.means, view), views))
    seen = np.zeros(len(gaussians), np.int32)
    queue = [(-len(rows), view) for view, rows in enumerate(shown) if len(rows)]
    heapq.heapify(queue)
    chosen: list[int] = []
    while queue:
        _, view = heapq.heappop(queue)
        rows = shown[view]
        gain = int(np.count_nonzero(seen[rows] < TIMES))
        if queue and gain < -queue[0][0]:  # gains only fall: another may be better now
            heapq.heappush(queue, (-gain, view))
        elif gain < _WORTH * len(rows):
            continue
        else:
            chosen.append(view)
            seen[rows] += 1
    return sorted(chosen)


def find_shown(means: NDArray[np.float32], view: CapturedView) -> NDArray[np.int64]:
    """Rows of the (N, 3) means, world meters, that lie on what the view's depth shows."""
    pixel, z = project(means, view)
    measured = _look_up(_without_gaps(view), pixel)
    off = np.abs(measured - z) - _WITHIN_SHARE * np.where(np.isinf(measured), 0, measured)
    return np.flatnonzero((off < _WITHIN_M) & (z > NEAR))


def find_in_view(gaussians: Gaussians, view: CapturedView) -> NDArray[np.int64]:
    """Rows of the Gaussians that may reach into the image, without those that lie far behind all that its depth shows
    around them."""
    pixel, z = project(gaussians.means, view)
    camera = view.camera
    side = 2 * math.ceil(_AROUND * camera.width) + 1
    farthest = cv2.dilate(_without_gaps(view), np.ones((side, side), np.uint8))
    hidden = z > _look_up(farthest, pixel) + _BEHIND_M
    largest = functools.reduce(np.maximum, gaussians.scales.T)
    with np.errstate(divide="ignore"):
        reach = np.float32(_REACH * max(camera.fx, camera.fy)) * largest / np.abs(z)
    (u, v), across, down = pixel.T, np.float32(camera.width), np.float32(camera.height)
    near = (u > -reach) & (v > -reach) & (u < across + reach) & (v < down + reach)
    return np.flatnonzero(near & (z > NEAR) & ~hidden)


def _without_gaps(view: CapturedView) -> NDArray[np.float32]:
    """(H, W) depth, meters; infinite where none was measured."""
    depth_m = view.depth_m.cpu().numpy()
    return np.where(depth_m > 0, depth_m, np.float32(np.inf))


def _look_up(image: NDArray[np.float32], pixel: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N,) values of an image at (N, 2) pixels; infinite outside it."""
    column, row = np.rint(pixel).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < image.shape[1]) & (row < image.shape[0])
    return np.where(inside, image[np.where(inside, row, 0), np.where(inside, column, 0)], np.float32(np.inf))


def project(means: NDArray[np.float32], view: CapturedView) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(N, 2) pixels and (N,) depths, meters, of (N, 3) means; the pixel of a mean that is not ahead is far away."""
    T, camera = view.T_cam_world.cpu().numpy(), view.camera
    x, y, z = (T[:3, :3] @ means.T + T[:3, 3:]).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = np.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), axis=1)
    return np.nan_to_num(np.where(z[:, None] > NEAR, pixel, np.float32(-1e9))), z
