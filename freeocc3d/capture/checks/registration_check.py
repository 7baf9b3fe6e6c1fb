"""Whether depth lies on color: the edges of both should meet.

An object that stands out in depth mostly differs in color from what is behind it. If depth is not registered to color,
its edges lie beside those of color, by the same shift or magnification everywhere.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ...core.sampling import spread_evenly
from ...core.types import Frame
from ...core.warnings import Notice
from ..base import Capture

_WIDTH = 320
"""Width to which images are reduced, pixels."""

_SHIFTS_X, _SHIFTS_Y = range(-32, 33, 4), range(-16, 17, 4)
_SCALES = tuple(np.round(1.06 ** np.arange(-5, 10), 4).tolist())
"""Shifts, pixels of the reduced image, and magnifications to try first; then those between the best and the next."""

_FAR_PX = 6.0
"""Distance at which a depth edge counts as far from any edge of color, pixels of the reduced image."""

_STEP = 0.06  # of the depth, from one pixel to the next but one, is an edge
_SAMPLES, _LEAST_FRAMES, _LEAST_EDGES, _MOST_EDGES = 10, 3, 150, 800
_LEAST_INSIDE, _LEAST_STRENGTH = 0.5, 40.0
"""Smallest share of the depth edges within the image, and smallest gradient of a color edge, 8 bits."""

_OFF_M, _OFF_PX = 0.05, 2.0
"""Smallest mean displacement of the surfaces that is told: meters, and pixels of the reduced image. The two cameras of
a Kinect are 25 mm apart: color lies that far off at any depth, which does little harm. This is twice as much."""

_GAIN = 0.12
"""Smallest decrease of the mean distance, as a share of it, by which another place is better."""


Place = tuple[float, int, int]
"""Magnification of depth, and its shift to the right and down, pixels of the reduced image."""


@dataclass(frozen=True)
class EdgeFit:
    """Where the edges of depth fit those of color best. shift: (2,) pixels of the frames, to the right and down.
    scale: magnification about the center.  gain: decrease of the mean distance there, as a share of it.
    off_m, off_px: mean displacement of the edges, meters on their surfaces and pixels of the reduced image."""

    shift: tuple[float, float]
    scale: float
    gain: float
    off_m: float
    off_px: float

    @property
    def doubtful(self) -> bool:
        """Whether depth fits color clearly better elsewhere."""
        return self.gain > _GAIN and self.off_m > _OFF_M and self.off_px > _OFF_PX


def check_registration(capture: Capture, frames: range) -> Notice | None:
    """A warning if the depth of the selected frames clearly does not lie on the color."""
    fit = fit_edges(_read(capture, frames))
    if fit is None or not fit.doubtful:
        return None
    right, down = fit.shift
    return Notice(
        "registration-doubtful",
        f"Color and depth of {capture.path} do not seem to lie on each other: the edges of depth meet those of color "
        f"better if depth moves by {right:+.0f}, {down:+.0f} pixels and grows by {fit.scale:.2f}, which is "
        f"{100 * fit.off_m:.0f} cm on the surfaces. Poses and colors suffer. Record depth aligned to color, or add the "
        "depth camera's intrinsics and its place: intrinsic/intrinsic_depth.txt and intrinsic/extrinsic_depth.txt.",
    )


def _read(capture: Capture, frames: range) -> Iterable[Frame]:
    for row in spread_evenly(len(frames), _SAMPLES):
        try:
            yield capture[frames[row]]
        except FrameError:
            continue


def fit_edges(frames: Iterable[Frame]) -> EdgeFit | None:
    """The shift and magnification of depth under which its edges lie nearest to those of color; None if too few edges
    show."""
    seen = [edges for frame in frames if (edges := _edges(frame)) is not None]
    if len(seen) < _LEAST_FRAMES:
        return None
    coarse = list(itertools.product(_SCALES, _SHIFTS_X, _SHIFTS_Y))
    scale, right, down = _best(seen, coarse)
    near = range(-3, 4)
    fine = [(scale * (1 + 0.02 * grow), right + x, down + y) for grow in near for x in near for y in near]
    scale, right, down = best = _best(seen, fine)
    unchanged = _mean_distance(seen, (1.0, 0, 0))
    gain = 1 - _mean_distance(seen, best) / unchanged if unchanged > 0 else 0.0
    factor = seen[0].frame_width / _WIDTH
    moved = [edges.displacements(best) for edges in seen]
    off_m = np.concatenate([pixels * edges.meters for pixels, edges in zip(moved, seen, strict=True)]).mean()
    return EdgeFit(
        (right * factor, down * factor), float(scale), gain, float(off_m), float(np.concatenate(moved).mean())
    )


@dataclass(frozen=True)
class _Edges:
    """Depth edges (K,) of a reduced image, and the distances (h, w) of its pixels from color edges, pixels.
    meters: (K,) width of a pixel on the surface at an edge."""

    u: NDArray[np.int64]
    v: NDArray[np.int64]
    meters: NDArray[np.float32]
    away: NDArray[np.float32]
    frame_width: int

    def displacements(self, place: Place) -> NDArray[np.float64]:
        """(K,) how far the edges move to a place, pixels."""
        scale, right, down = place
        x = (self.u - (_WIDTH - 1) / 2) * (scale - 1) + right
        y = (self.v - (len(self.away) - 1) / 2) * (scale - 1) + down
        return np.hypot(x, y)

    def mean_distance(self, place: Place) -> float:
        """Mean saturating distance of the depth edges, moved to a place, from color edges."""
        scale, right, down = place
        height = len(self.away)
        center_x, center_y = (_WIDTH - 1) / 2, (height - 1) / 2
        x = np.rint(center_x + (self.u - center_x) * scale + right).astype(np.int32)
        y = np.rint(center_y + (self.v - center_y) * scale + down).astype(np.int32)
        inside = (x >= 0) & (y >= 0) & (x < _WIDTH) & (y < height)
        if inside.mean() < _LEAST_INSIDE:
            return _FAR_PX
        return float(self.away[y[inside], x[inside]].mean())


def _best(seen: list[_Edges], places: list[Place]) -> Place:
    """The place of the least distance. In clutter, some edge is near wherever a strongly magnified one lands, so
    magnified ones must be nearer."""
    return min(places, key=lambda place: _mean_distance(seen, place) * (1 + abs(np.log(place[0]))))


def _mean_distance(seen: list[_Edges], place: Place) -> float:
    return float(np.mean([edges.mean_distance(place) for edges in seen]))


def _edges(frame: Frame) -> _Edges | None:
    """The edges of a frame; None if it has too few."""
    height = max(8, round(frame.color.shape[0] * _WIDTH / frame.color.shape[1]))
    gray = cv2.resize(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), (_WIDTH, height), interpolation=cv2.INTER_AREA)
    depth = cv2.resize(frame.depth_m, (_WIDTH, height), interpolation=cv2.INTER_NEAREST)
    strength = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    color_edges = strength > max(float(np.quantile(strength, 0.85)), _LEAST_STRENGTH)
    v, u = np.nonzero(_depth_edges(depth))
    if len(u) < _LEAST_EDGES or not color_edges.any():
        return None
    step = max(1, len(u) // _MOST_EDGES)
    away = np.minimum(cv2.distanceTransform(np.uint8(~color_edges), cv2.DIST_L2, 3), _FAR_PX)
    meters = depth[v, u] * (frame.color.shape[1] / _WIDTH / frame.intrinsics.fx)
    return _Edges(u[::step], v[::step], meters[::step].astype(np.float32), away, frame.color.shape[1])


def _depth_edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels of the nearer side of a step of depth."""
    edges = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        for direction in (-1, 1):
            other = np.roll(depth, direction, axis=axis)
            edges |= (depth > 0) & (other > depth * (1 + _STEP))
    edges[:2], edges[-2:], edges[:, :2], edges[:, -2:] = False, False, False, False
    return edges
