"""Finds the planes of a building from few measured points.

A bare wall has no texture to match, but the edges on and around it have. Between them, the surface of the scan has only
large triangles; the plane of the wall gives the right position. Most walls are at right angles. So three directions are
found first, along which most points lie in layers, and then the layers.
Sources of the ideas: J. Coughlan, A. Yuille, Manhattan World, ICCV 1999; Y. Furukawa et al., Manhattan-world Stereo,
CVPR 2009.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .building_planes import Layout, Plane
from .scan_points import ScanPoints

_MOST_PLANES = 60
_LEAST_POINTS = 60
# Lengths are in cells of the points, sizes of pieces in squares of a plane.
_WITHIN = 1.0  # largest distance of a point on the plane
_LAYER = 0.6  # thickness of the layers for counting points
_BESIDE = 4.0  # largest distance to look for a surface that crosses the plane
_SQUARE = 2.0
_SEEN_THROUGH = 3.0  # smallest distance behind the plane of a point seen through it, or 3 sigma
_PIECE, _HELD = 60, 30
_GAPS = (4, 8, 16, 32)
_GAP_OF_PIECE = 0.3  # largest closed gap, as a share of a piece's length
_REACH = 34  # squares by which a plane may extend beyond its points
_MOST_SQUARES = 1 << 24  # a larger plane consists of stray points

_TURNS_DEG = (
    -0.5,
    -0.25,
    0.0,
    0.25,
    0.5,
)  # of the second and third direction about the first, for walls not quite at right angles
_LEAST_ALIKE = 0.9  # smallest cosine between a plane's normals before and after the fit
_TILT = 0.003  # radians: prior standard deviation of a plane's normal
_DEPENDENT = 50.0  # points per independent measurement
_BEHIND = 0.01  # largest share of the points behind an outermost wall
_OUTERMOST = 60  # smallest number of squares with points on an outermost plane
_SAMPLE, _SAMPLE_NORMALS = 40_000, 4000  # largest number of points and normals for the search for directions
_SAME_DIRECTION = 0.99  # smallest cosine between normals of one surface: 8 degrees
_FIRST_TURN_DEG = 2  # step between the azimuths of the first search
_SEARCH = ((1.0, 2.0), (0.5, 2.0), (0.25, 1.0), (0.1, 1.0))
"""Step of a turn in degrees and thickness of the layers in cells, from coarse to fine."""

_SEARCHED = 4  # largest number of turns with each step
_AZIMUTHS_DEG = np.arange(-3.0, 3.01, 0.125)  # turns about the normal in the last search
_SURROUNDINGS = 15  # layers around a layer; its count is compared with their mean
_FITTED_WITHIN = (1.5, 1.5, 1.5, 1.0, 1.0, 1.0)  # cells: largest distance of a point from the plane, fit after fit
_TILTED = 4  # rounds of the fit with a prior normal
_SUREST = 0.25  # cells: smallest standard deviation of a point, because neighbors share errors
_STRAY = 0.5  # percent of a plane's points to ignore at either end of each axis, for its bounds
_BRIDGED = 5  # squares: pieces less than half of this apart become one


@dataclass(frozen=True)
class _Bounded:
    """A plane within its support. free: (U, V) squares that no ray crosses.  held: number of squares with points.
    taken: (P,) the points on the plane."""

    plane: Plane
    free: NDArray[np.bool_]
    held: int
    taken: NDArray[np.bool_]


def detect_layout(points: ScanPoints, centers: NDArray[np.float64], normals: NDArray[np.float64]) -> Layout:
    """Find the planes of a scan.

    centers: (C, 3) camera centers, indexed by ``points.ray_camera``.  normals: (N, 3) unit surface normals of any sign,
    at least one of a wall or floor.
    """
    if len(points.points) < _LEAST_POINTS or not len(normals):
        return Layout(())
    axes = find_directions(points, normals)
    return Layout(_outermost(points, centers, axes) + _layers(points, centers, axes))


def find_directions(points: ScanPoints, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) orthogonal directions, as rows, along which points lie in layers. The first one belongs to the layer with
    most points, usually the floor, and is fitted to its points."""
    X, cell = points.points - points.points.mean(axis=0), points.cell_m
    some = X[np.random.default_rng(0).permutation(len(X))[:_SAMPLE]]
    axes = _coarse(some, _commonest(normals), cell)
    for step, thickness in _SEARCH:
        for _ in range(_SEARCHED):
            turned = [axes] + [axes @ _turn(axes[k], by * step).T for k in range(3) for by in (-2, -1, 1, 2)]
            best = int(np.argmax([_layered(some, rows, thickness * cell) for rows in turned]))
            axes = turned[best]
            if best == 0:
                break
    counts = [np.bincount(_layer(X @ row, cell)) for row in axes]
    first = int(np.argmax([count.max() for count in counts]))
    height = X @ axes[first]
    normal = _fitted(X, axes[first], float(height.min()) + (int(np.argmax(counts[first])) + 0.5) * cell, cell)
    across = axes[(first + 1) % 3] - normal * (normal @ axes[(first + 1) % 3])
    across /= np.linalg.norm(across)
    axes = np.stack((normal, across, np.cross(normal, across)))
    sure = X[points.sigma_m <= np.median(points.sigma_m)]
    sharp = [sum(_peaks(sure, row, 0.5 * cell) for row in (axes @ _turn(normal, by).T)[1:]) for by in _AZIMUTHS_DEG]
    return np.asarray(axes @ _turn(normal, float(_AZIMUTHS_DEG[int(np.argmax(sharp))])).T)


def _commonest(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    some = normals[np.random.default_rng(0).permutation(len(normals))[:_SAMPLE_NORMALS]]
    alike = np.abs(some @ some.T) > _SAME_DIRECTION
    best = int(np.argmax(alike.sum(axis=1)))
    held = some[alike[best]]
    mean = (held * np.sign(held @ some[best])[:, None]).sum(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _coarse(X: NDArray[np.float64], normal: NDArray[np.float64], cell: float) -> NDArray[np.float64]:
    across = np.linalg.svd(normal[None])[2][1]
    axes = np.stack((normal, across, np.cross(normal, across)))
    turned = [axes @ _turn(normal, by).T for by in range(0, 90, _FIRST_TURN_DEG)]
    return turned[int(np.argmax([_layered(X, rows, 2.0 * cell) for rows in turned]))]


def _turn(axis: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    return np.asarray(cv2.Rodrigues(axis * np.radians(degrees))[0], np.float64)


def _layer(heights: NDArray[np.float64], thickness: float) -> NDArray[np.int64]:
    return np.floor((heights - heights.min()) / thickness).astype(np.int64)


def _layered(X: NDArray[np.float64], axes: NDArray[np.float64], thickness: float) -> float:
    """How unevenly points are distributed along the axes."""
    return float(sum((np.bincount(_layer(X @ row, thickness)).astype(float) ** 2).sum() for row in axes))


def _peaks(X: NDArray[np.float64], axis: NDArray[np.float64], thickness: float) -> float:
    """The same for one axis, counting only peaks above their surroundings: a floor seen edge-on gives no azimuth."""
    count = np.bincount(_layer(X @ axis, thickness)).astype(float)
    count += np.append(count[1:], 0.0)
    around = np.convolve(count, np.full(_SURROUNDINGS, 1 / _SURROUNDINGS))[_SURROUNDINGS // 2 :]
    around = around[: len(count)]  # same length, even with few layers
    return float((np.maximum(count - around, 0.0) ** 2).sum())


def _fitted(X: NDArray[np.float64], normal: NDArray[np.float64], offset: float, cell: float) -> NDArray[np.float64]:
    """Fit a plane to the points near a given plane. Returns its normal."""
    for within in _FITTED_WITHIN:
        held = X[np.abs(X @ normal - offset) < within * cell]
        if len(held) < _LEAST_POINTS:
            break
        mean = held.mean(axis=0)
        found = np.linalg.eigh((held - mean).T @ (held - mean))[1][:, 0]
        if abs(found @ normal) < _LEAST_ALIKE:
            break  # the points lie on a line
        normal = found * np.sign(found @ normal)
        offset = float(normal @ mean)
    return normal


def _layers(points: ScanPoints, centers: NDArray[np.float64], axes: NDArray[np.float64]) -> list[Plane]:
    """Planes in order of their number of points. Each point counts for one plane only.

    Source: P. Hough, Method and Means for Recognizing Complex Patterns, 1962.
    """
    X, cell = points.points, points.cell_m
    rows, of_axis = [axes[0]], [0]
    for axis, other in ((1, 2), (2, 1)):
        for degrees in _TURNS_DEG:
            row = axes[axis] + np.radians(degrees) * axes[other]
            rows.append(row / np.linalg.norm(row))
            of_axis.append(axis)
    normals, group = np.stack(rows), np.array(of_axis)
    mean, thickness = X.mean(axis=0), _LAYER * cell
    heights = (X - mean) @ normals.T
    lowest = float(heights.min())
    layer = np.floor((heights - lowest) / thickness).astype(np.int64)
    layers = int(layer.max()) + 2
    count = np.stack([np.bincount(column, minlength=layers) for column in layer.T]).astype(float)
    left = np.ones(len(X), bool)
    found: list[Plane] = []
    while len(found) < _MOST_PLANES:
        thick = count[:, :-1] + count[:, 1:]
        row, at = np.unravel_index(int(np.argmax(thick)), thick.shape)
        if thick[row, at] < _LEAST_POINTS:
            break
        plane = _tilted(
            X, points.sigma_m, left, normals[row], lowest + (at + 1) * thickness + mean @ normals[row], cell
        )
        bounded = None if plane is None else _bounded(points, centers, *plane)
        alike = group == group[row] if bounded is not None else np.arange(len(group)) == row
        count[alike, max(at - 1, 0) : at + 2] = -np.inf  # do not find it again
        if bounded is None:
            continue
        found.append(bounded.plane)
        gone = np.flatnonzero(left & bounded.taken)
        for k in range(len(normals)):
            count[k] -= np.bincount(layer[gone, k], minlength=layers)
        left[gone] = False
    return found


def _tilted(
    X: NDArray[np.float64], sigma_m: NDArray[np.float64], left: NDArray[np.bool_], start: NDArray[np.float64],
    offset: float, cell: float,
) -> tuple[NDArray[np.float64], float] | None:  # fmt: skip
    """Fit a plane to the points near a given plane. The normal has a prior of a few milliradians, so points along a
    single edge cannot turn it. Returns (normal, offset), or None with too few points."""
    normal, across = start, np.linalg.svd(start[None])[2][1:]
    for _ in range(_TILTED):
        held = left & (np.abs(X @ normal - offset) < _WITHIN * cell)
        if np.count_nonzero(held) < _LEAST_POINTS:
            return None
        weight = 1.0 / np.maximum(sigma_m[held], _SUREST * cell) ** 2
        mean = (X[held] * weight[:, None]).sum(axis=0) / weight.sum()
        moved = X[held] - mean
        weight /= weight.max() * _DEPENDENT * (0.5 * _WITHIN * cell) ** 2
        along, above = moved @ across.T, moved @ start
        information = (along * weight[:, None]).T @ along + np.eye(2) / _TILT**2
        normal = start - np.linalg.solve(information, (along * weight[:, None]).T @ above) @ across
        normal = normal / np.linalg.norm(normal)
        offset = float(normal @ mean)
    return normal, offset


def _bounded(
    points: ScanPoints, centers: NDArray[np.float64], normal: NDArray[np.float64], offset: float
) -> _Bounded | None:
    """The plane within the support of its points; None if they are few or scattered."""
    X, cell = points.points, points.cell_m
    square = _SQUARE * cell
    height = X @ normal - offset
    on = np.abs(height) < _WITHIN * cell
    axes = np.linalg.svd(normal[None])[2][1:]
    place = X[on] @ axes.T
    if len(place) < _LEAST_POINTS:
        return None
    corner = np.percentile(place, _STRAY, axis=0) - _REACH * square
    shape = np.ceil((np.percentile(place, 100 - _STRAY, axis=0) + _REACH * square - corner) / square).astype(np.int64)
    if shape.prod() > _MOST_SQUARES:
        return None

    def squares(some: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        index = np.floor((some @ axes.T - corner) / square).astype(np.int64)
        return index, np.asarray(((index >= 0) & (index < shape)).all(axis=1))

    def counted(some: NDArray[np.float64]) -> NDArray[np.float32]:
        index, inside = squares(some)
        flat = np.ravel_multi_index(tuple(index[inside].T), tuple(shape))
        return np.bincount(flat, minlength=int(shape.prod())).reshape(shape).astype(np.float32)

    beside = ~on & (np.abs(height) < _BESIDE * cell)
    count, above, below = counted(X[on]), counted(X[beside & (height > 0)]), counted(X[beside & (height < 0)])
    around = np.ones((3, 3), np.uint8)
    # Another surface crosses the plane where as many points lie on both sides as on the plane.
    both_sides = (cv2.dilate(above, around) > 0) & (cv2.dilate(below, around) > 0)
    crossed = both_sides & (cv2.blur(above + below, (3, 3)) / (_BESIDE - 1.0) > 0.5 * cv2.blur(count, (3, 3)))
    held = _pieces((count >= 1) & ~crossed)
    if np.count_nonzero(held) < _HELD:
        return None
    from_camera, to_point = centers @ normal - offset, height
    a, b = from_camera[points.ray_camera], to_point[points.ray_point]
    beyond = np.maximum(_SEEN_THROUGH * cell, 3.0 * points.sigma_m[points.ray_point])
    through = np.flatnonzero((a * b < 0) & (np.abs(b) > beyond))
    share = (a[through] / (a[through] - b[through]))[:, None]
    start = centers[points.ray_camera[through]]
    rays = counted(start + share * (X[points.ray_point[through]] - start))
    held = _pieces(held & (rays <= 2 * count))
    if np.count_nonzero(held) < _HELD:
        return None
    free = cv2.dilate(((rays >= 2) & (rays > 2 * count)).astype(np.uint8), around) > 0
    support = _closed(held) & ~free
    support = (cv2.morphologyEx(support.astype(np.uint8), cv2.MORPH_OPEN, around) > 0) | held
    near = np.abs(height) < 2.0 * _WITHIN * cell
    index, inside = squares(X[near])
    taken = np.zeros(len(X), bool)
    rows = np.flatnonzero(near)[inside]
    taken[rows] = cv2.dilate(held.astype(np.uint8), around)[tuple(index[inside].T)] > 0
    plane = Plane(normal, offset, axes, corner, square, support, outermost=False)
    return _Bounded(plane, ~free | held, int(np.count_nonzero(held)), taken)


def _pieces(held: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Remove small pieces."""
    _, labels, sizes, _ = cv2.connectedComponentsWithStats(
        cv2.dilate(held.astype(np.uint8), np.ones((_BRIDGED, _BRIDGED), np.uint8))
    )
    return held & np.isin(labels, np.flatnonzero(sizes[:, cv2.CC_STAT_AREA] >= _PIECE))


def _closed(held: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Close the gaps that are small relative to the pieces around them."""
    grid = held.astype(np.uint8)
    for gap in _GAPS:
        _, labels, sizes, _ = cv2.connectedComponentsWithStats(cv2.dilate(grid, _disc(2)))
        lengths = sizes[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
        long = np.flatnonzero(lengths * _GAP_OF_PIECE >= gap)
        some = (grid * np.isin(labels, long[long > 0])).astype(np.uint8)
        if not some.any():
            break
        grid |= cv2.morphologyEx(some, cv2.MORPH_CLOSE, _disc(gap))
    return grid > 0


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _outermost(points: ScanPoints, centers: NDArray[np.float64], axes: NDArray[np.float64]) -> list[Plane]:
    """The floor, the ceiling and the outer walls: in each direction, the layer with most points among those with hardly
    anything behind them. Each extends to all squares that no ray crosses."""
    X, cell = points.points, points.cell_m
    everything, planes = np.ones(len(X), bool), []
    for outward in np.concatenate((axes, -axes)):
        height = X @ outward
        lowest = float(height.min())
        count = np.bincount(_layer(height, _LAYER * cell)).astype(float)
        count[:-1] += count[1:]
        offsets = lowest + (np.arange(len(count)) + 1) * _LAYER * cell
        behind = 1.0 - np.searchsorted(np.sort(height), offsets + _SEEN_THROUGH * cell) / len(X)
        count[(behind > _BEHIND) | (offsets < (centers @ outward).max())] = 0.0
        best = int(np.argmax(count))
        plane = _tilted(X, points.sigma_m, everything, outward, offsets[best], cell) if count[best] else None
        bounded = None if plane is None else _bounded(points, centers, *plane)
        if bounded is not None and bounded.held >= _OUTERMOST:
            planes.append(replace(bounded.plane, support=bounded.free, outermost=True))
    return planes
