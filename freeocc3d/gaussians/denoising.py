"""Denoises a surface: moves each point to the mean of the surfaces in the depth maps that show it.

A point measured in a single image has the noise of that image: a wall seen by ten frames is as thick as their depths
differ. Along the viewing ray of every frame t that shows a point p, the depth map gives the distance of the surface:

    p' = p + sum_t w_t (d_t(u_t) - z_t) r_t / sum_t w_t,   w_t = 1 / sigma(d_t)^2,   r_t = (p - c_t) / z_t,

over the frames with |d_t - z_t| within reach. This is a truncated signed distance that is evaluated only at the points:
it needs no grid, and a wall becomes one layer thick. Frames that look at the other side of a board or a door do not
count, because they show another surface.

The same frames tell which points are no surface: what was there only for a while, depth between the two sides of an
edge, specks behind a pane. A point is removed if more frames see through it than show it, or if several see far past it
after the last one that shows it: it has left. If only few frames show it,
then frames whose pixel has no depth there count a little, too: a sensor misses black, shiny and slanted surfaces often,
but not always. And what a single frame shows holds only if few others could have shown it. Where more frames lack depth
than show a point, it is removed, too, if the points around it are sparse: a speck is alone, a dark thing is a surface.

Where poses are exact, a frame that sees through a point looks past an edge, and says nothing of where the surface is.
Where they are not, it may as well be registered wrongly. So the reach grows with the registration error tau, and a
frame that sees through counts as a distance of twice the reach, with the share
tau^2 / (tau^2 + sigma^2) of its weight. tau is what the distances of all points scatter more
than their depths' noise explains (median of the points; 0 in the rendered captures, about a centimeter with a Kinect's
given poses).

Source: B. Curless, M. Levoy, A Volumetric Method for Building Complex Models from Range Images, SIGGRAPH 1996 (the
weighted mean of projective distances, cut off in front of the surface).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core.compiling import njit
from ..core.depth_noise import look_up_sigma, take_sigma
from ..core.transforms import invert
from ..core.types import PosedFrame
from .depth_edges import is_at_edge, mask_away_from_edges

_REACH_M, _REACH_SIGMAS = 0.05, 3.0
"""A depth map shows a point if it ends within this many meters of it, plus this many standard deviations of its depth
and registration: small pose errors, and 99.7 % of the rest. Without the registration, the IoU of the kitchen at its
given poses falls by 1.1 points."""

_SURE = 6
"""Frames that show a point beyond doubt. Of the points of walls and furniture in the shipped captures, 94 % have more,
and of specks behind panes 2 %."""

_BLANK = 1 / 20
"""What a frame without depth at a point counts, in frames that see through it, unless the point is beyond doubt. Of
the voxels that panes with specks in a tenth of their pixels bring into the three captures, this removes 79 to 93 %. At
1 / 10, it removes 89 to 95 %, but loses more of what lies behind large things without depth."""

_FAR = 3.0
"""A frame sees far past a point if its depth ends at this many times the distance within which it would show it. So a
pose that has drifted does not count."""

_LEFT, _LEFT_SHARE = 5, 0.25
"""Frames that see far past a point after the last one that shows it, and their least ratio to those that show it, of a
thing that has left. Of the points of still rooms, less than one in a thousand has five."""

_OTHERS = 3
"""Frames that may fail to confirm what a single frame shows."""

_NEIGHBORS, _SPARSE = 5, 2.5
"""A doubtful point is removed if its fifth neighbor is farther than this many times the usual distance: specks fill
the space behind a pane, and the points of a surface are as close there as elsewhere. Of the voxels that panes with
specks leave in the three captures, this removes two thirds to three quarters; of their surface behind panes, it loses
another 0.3 %."""

_ENOUGH_POINTS = 2000
"""Points whose median distance is usual."""

_BEYOND = 2.0
"""Reaches that a frame which sees through a point counts as its distance."""

_ENOUGH = 8
"""Frames that show a point whose distances' scatter is used for the registration error."""

_MOST_NEEDED, _SHARE_NEEDED = 3, 1 / 25
"""Where frames are many, a point needs this share of those that show a usual point, but not more than the first value:
stray depth repeats in few frames, a surface in many."""

_SUMS = 10
"""Columns of a point's sums."""

_NEAREST_M = 1e-3
"""Smallest depth of a point that a camera shows, meters: projection divides by the depth."""


@dataclass
class DenoisedPoints:
    """N points and what the depth maps show of them.

    points: (N, 3) float64 world, meters.  weights: (N,) 1 over the variance of the mean distance along the ray, m^-2; 0
    if no image shows the point.
    best: (N,) the largest 1 / sigma^2.  keyframe: (N,) int32 the keyframe of the frame that gives it (-1: none).
    kept: (N,) bool, false if the evidence against the point outweighs the images that show it.
    """

    points: NDArray[np.float64]
    weights: NDArray[np.float64]
    best: NDArray[np.float64]
    keyframe: NDArray[np.int32]
    kept: NDArray[np.bool_]


def denoise(
    points: NDArray[np.float64],
    directions: NDArray[np.float64],
    frames: Iterable[PosedFrame],
    edge: float,
    reach_m: float,
    sample: Iterable[PosedFrame] = (),
) -> DenoisedPoints:
    """Moves (N, 3) world points to the mean surface of the depth maps.

    directions: (N, 3) the rays along which the points were measured, world, of any length.  frames: read once, in the
    order of time. Pixels with depth 0 do not move points, and neither do pixels where depth jumps by more than ``edge``
    times itself.  reach_m: the greatest depth of any frame. Beyond, a pixel without depth says nothing.  sample: some
    of the frames, from which the registration error is estimated beforehand; without any, the reach has none.
    """
    registration_m = estimate_registration(*_look_at_all(points, directions, sample, edge, reach_m, 0.0)[:2])
    sums, shown, through, blank, past, best, keyframe = _look_at_all(
        points, directions, frames, edge, reach_m, registration_m
    )
    offset, weights = weigh(sums, shown)
    moved, kept = points + offset, are_surfaces(shown, through, blank, past)
    doubtful = kept & (shown < _SURE) & (blank > shown)
    kept[doubtful] = _have_neighbors(moved[doubtful], moved[kept])
    return DenoisedPoints(moved, weights, best, keyframe, kept)


def _look_at_all(
    points: NDArray[np.float64],
    directions: NDArray[np.float64],
    frames: Iterable[PosedFrame],
    edge: float,
    reach_m: float,
    registration_m: float,
) -> tuple[NDArray[Any], ...]:
    """Returns what ``_look`` sums over frames: sums, shown, through, blank, past, best, keyframe."""
    n = len(points)
    sums, best, keyframe = np.zeros((n, _SUMS)), np.zeros(n), np.full(n, -1, np.int32)
    shown, through, blank, past = np.zeros((4, n), np.int32)
    for frame, T_world_cam, row in frames:
        camera = frame.intrinsics
        T_cam_world = invert(T_world_cam)
        _look(
            points, directions, frame.depth_m, take_sigma(frame), edge, reach_m, registration_m,
            T_cam_world[:3, :3].copy(), T_cam_world[:3, 3].copy(), (camera.fx, camera.fy, camera.cx, camera.cy), row,
            sums, shown, through, blank, past, best, keyframe,
        )  # fmt: skip
    return sums, shown, through, blank, past, best, keyframe


def are_surfaces(
    shown: NDArray[np.int32], through: NDArray[np.int32], blank: NDArray[np.int32], past: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """(N,) whether points are kept, from the numbers (N,) of frames that show them, that see through them, that have no
    depth there, and that see far past them after the last one that shows them."""
    against = through + np.where(shown < _SURE, _BLANK * blank, 0.0)
    alone = (shown < 2) & (through + blank > _OTHERS)
    left = past >= np.maximum(_LEFT, _LEFT_SHARE * shown)
    few = shown < _count_needed(shown)
    return np.asarray((against <= np.maximum(shown, 1)) & ~alone & ~left & ~few)


def _have_neighbors(points: NDArray[np.float64], kept: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether points (N, 3), which are some of the kept ones (M, 3), are surrounded as those on a surface are."""
    if len(kept) <= _NEIGHBORS or not len(points):
        return np.zeros(len(points), bool)
    tree = cKDTree(kept)
    some = kept[:: max(1, len(kept) // _ENOUGH_POINTS)]
    usual, own = (tree.query(each, k=[_NEIGHBORS + 1], workers=-1)[0].ravel() for each in (some, points))
    return np.asarray(own <= _SPARSE * np.median(usual))


def weigh(sums: NDArray[np.float64], shown: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the (N, 3) moves of the points, meters, and their (N,) weights. sums: (N, 10) as ``_look`` makes them.
    shown: (N,) frames that show each point."""
    weight = sums[:, 3]
    seen = weight > 0
    variance = np.divide(shown, weight, out=np.ones(len(sums)), where=seen)  # of a usual frame's depth
    registration = estimate_registration(sums, shown) ** 2
    share = registration / (registration + variance)
    total = np.where(seen, weight + share * sums[:, 9], 1.0)
    offset = np.where(seen[:, None], (sums[:, :3] + share[:, None] * sums[:, 6:9]) / total[:, None], 0.0)
    return offset, np.where(seen, shown / (variance + registration), 0.0)


def estimate_registration(sums: NDArray[np.float64], shown: NDArray[np.int32]) -> float:
    """Returns tau, meters; 0 if no point is shown by enough frames."""
    enough = shown >= _ENOUGH
    if not enough.any():
        return 0.0
    count, weight = shown[enough], sums[enough, 3]
    scatter = (sums[enough, 5] - sums[enough, 4] ** 2 / weight) / weight * count / (count - 1)
    return float(np.sqrt(max(np.median(scatter - count / weight), 0.0)))


def _count_needed(shown: NDArray[np.int32]) -> int:
    """Returns the number of frames that have to show a point."""
    usual = float(np.median(shown[shown > 0])) if shown.any() else 0.0
    return min(_MOST_NEEDED, int(_SHARE_NEEDED * usual))


@njit(parallel=True, cache=True)
def _look(
    points: NDArray[np.float64],
    directions: NDArray[np.float64],
    depth_m: NDArray[np.float32],
    sigma_m: NDArray[np.float32],
    edge: float,
    reach_m: float,
    registration_m: float,
    R: NDArray[np.float64],
    t: NDArray[np.float64],
    camera: tuple[float, float, float, float],
    row: int,
    sums: NDArray[np.float64],
    shown: NDArray[np.int32],
    through: NDArray[np.int32],
    blank: NDArray[np.int32],
    past: NDArray[np.int32],
    best: NDArray[np.float64],
    keyframe: NDArray[np.int32],
) -> None:
    """Adds what one depth map shows of each point. sums: (N, 10), for frames that show a point of weighted
    offsets x, y, z, weights, weighted distances and their squares; for those that see through it of weighted offsets x,
    y, z and weights."""
    fx, fy, cx, cy = camera
    height, width = depth_m.shape
    for n in prange(len(points)):
        x = R[0, 0] * points[n, 0] + R[0, 1] * points[n, 1] + R[0, 2] * points[n, 2] + t[0]
        y = R[1, 0] * points[n, 0] + R[1, 1] * points[n, 1] + R[1, 2] * points[n, 2] + t[1]
        z = R[2, 0] * points[n, 0] + R[2, 1] * points[n, 1] + R[2, 2] * points[n, 2] + t[2]
        if z < _NEAREST_M:
            continue
        u, v = fx * x / z + cx + 0.5, fy * y / z + cy + 0.5
        if not (u >= 0 and v >= 0 and u < width and v < height):
            continue
        column, line = math.floor(u), math.floor(v)
        depth = np.float64(depth_m[line, column])
        if depth <= 0:
            blank[n] += z <= reach_m
            continue
        if is_at_edge(depth_m, line, column, edge):
            continue
        sigma = look_up_sigma(sigma_m, line, column, z)
        reach = _REACH_M + _REACH_SIGMAS * math.sqrt(sigma * sigma + registration_m * registration_m)
        beyond = depth - z
        if beyond < -reach:
            continue  # something in front hides it
        passes = beyond > reach
        through[n] += passes
        past[n] += beyond > _FAR * reach
        ray = (
            R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
            R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
            R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
        )
        if ray[0] * directions[n, 0] + ray[1] * directions[n, 1] + ray[2] * directions[n, 2] <= 0:
            continue  # it shows the other side
        w = 1.0 / (sigma * sigma)
        distance = _BEYOND * reach if passes else beyond
        first = 6 if passes else 0
        for i in range(3):
            sums[n, first + i] += w * distance / z * ray[i]
        if passes:
            sums[n, 9] += w
            continue
        sums[n, 3] += w
        sums[n, 4] += w * beyond
        sums[n, 5] += w * beyond * beyond
        shown[n] += 1
        past[n] = 0
        if w > best[n]:
            best[n], keyframe[n] = w, row


def look_reference(
    points: NDArray[np.float64],
    directions: NDArray[np.float64],
    posed: PosedFrame,
    edge: float,
    reach_m: float,
    registration_m: float = 0.0,
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64], NDArray[np.bool_]]:
    """What one depth map shows of (N, 3) points, in plain NumPy: the (N, 10) sums, and (N,) whether it shows the point,
    how far it sees through it in units of the reach, 0 if it does not, and whether it has no depth there."""
    frame, camera = posed.frame, posed.frame.intrinsics
    depth_m = np.where(mask_away_from_edges(frame.depth_m, edge), frame.depth_m, 0)
    T = invert(posed.T_world_cam)
    p = points @ T[:3, :3].T + T[:3, 3]
    z = np.where(p[:, 2] < _NEAREST_M, np.nan, p[:, 2])
    ray = points - posed.T_world_cam[:3, 3]
    with np.errstate(invalid="ignore"):
        pixel = np.floor(p[:, :2] / z[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy) + 0.5)
        inside = ((pixel >= 0) & (pixel < (camera.width, camera.height))).all(axis=1)
        column, line = np.where(np.asarray(inside)[:, None], pixel, 0).astype(int).T
        depth = np.where(inside, depth_m[line, column], 0)
        stated = frame.depth_sigma_m
        sigma = (frame.sensor.compute_sigma(z) if stated is None else stated[line, column]).astype(np.float64)
        beyond, reach = depth - z, _REACH_M + _REACH_SIGMAS * np.hypot(sigma, registration_m)
        shown, through = (depth > 0) & (np.abs(beyond) <= reach), (depth > 0) & (beyond > reach)
        blank = inside & (frame.depth_m[line, column] <= 0) & (z <= reach_m)
    front = (ray * directions).sum(axis=1) > 0
    sums = np.zeros((len(points), _SUMS))
    for mask, distance, first in ((shown & front, beyond, 0), (through & front, _BEYOND * reach, 6)):
        weight = 1 / sigma[mask] ** 2
        sums[mask, first : first + 3] = (weight * distance[mask] / z[mask])[:, None] * ray[mask]
        sums[mask, first + 3] = weight
        if first == 0:
            sums[mask, 4:6] = np.stack((weight * distance[mask], weight * distance[mask] ** 2), axis=1)
    return sums, shown & front, np.where(through, beyond / reach, 0.0), blank
