"""Planes that all views of a scan share: floors, walls and tables with enough texture to be measured.

Views that measure a floor each by itself differ by their noise, and the floor gets as thick. What all of them measured
says where its plane is far better than any one does; depths that cannot be told from it are moved there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...types import Intrinsics
from .consistency import DepthImage

_PATCHES_EACH = 2000  # of a view
_PATCH, _FILLED, _FLAT = 7, 0.6, 0.01  # pixels to either side; share with a depth; of it, how far off a plane
_SAME = 2.5  # standard deviations up to which a depth cannot be told from a plane's
_FLATTEST = 0.05  # cosine between a plane's normal and the way it is seen
_SAMPLE, _TRIES = 4000, 400  # points on which planes are tried, and of these the ones whose own planes they are
_THICKNESS, _ALIKE = 0.015, 0.93  # of the scale: how far a point may lie from its plane; cosine between their normals
_LEAST_POINTS = 100
_CELL = 0.04  # of the scale
_LEAST_IN_CELL, _LEAST_PIECE, _LEAST_CELLS = 2, 25, 12  # points; cells, with those around
_GAP = 25  # cells: holes of the support up to twice as wide are closed
_MOST_CELLS = 1 << 24  # a plane of more is some stray points far apart
_BEYOND = 1  # cells that a plane goes on at its rim


@dataclass(frozen=True)
class ScanPlane:
    """The points X of the world with ``normal`` · X = ``offset`` in those cells of the plane that hold measured points,
    or lie between such.

    normal: (3,) float64, of length 1.  offset, sigma_m: metres; the latter is the standard deviation of its points.
    axes: (2, 3) orthonormal, along the plane.  support: (U, V) bool of square cells of edge ``cell`` metres, the lower
    corner of the first of which has the coordinates ``corner`` along the axes.
    """

    normal: NDArray[np.float64]
    offset: float
    sigma_m: float
    axes: NDArray[np.float64]
    corner: NDArray[np.float64]
    cell: float
    support: NDArray[np.bool_]

    def met(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """How many times each of (..., 3) directions, from ``origin``, reaches the plane (0 = never), and whether the
        surface is there."""
        facing = directions @ self.normal
        height = self.offset - float(origin @ self.normal)
        times = np.divide(height, facing, out=np.zeros_like(facing), where=np.abs(facing) > 1e-6)
        times = np.maximum(times, 0.0)
        there = self._supported(origin + times[..., None] * directions)
        return times, np.asarray(there & (times > 0))

    def _supported(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        index = np.floor((points @ self.axes.T - self.corner) / self.cell)
        inside = np.asarray(((index >= 0) & (index < self.support.shape)).all(axis=-1))
        u, v = np.moveaxis(np.where(inside[..., None], index, 0).astype(np.int64), -1, 0)
        return np.logical_and(inside, self.support[u, v])


def scan_planes(depths: Iterable[DepthImage], most: int) -> list[ScanPlane]:
    """The planes of a scan, at most so many, from what its views measured."""
    found = [patches(depth, _PATCHES_EACH) for depth in depths]
    points, normals, z = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return find_planes(points, normals, float(np.median(z)), most) if len(z) else []


def snapped(depth: DepthImage, planes: Sequence[ScanPlane], pixel: float) -> DepthImage:
    """``depth`` with those pixels moved that cannot be told from the nearest of ``planes``: to the mean of both,
    weighted by their variances. pixel: the inverse depth by which a plane may be seen wrongly, 1 / metres."""
    inverse, sigma = depth.inverse.copy(), depth.sigma.copy()
    least = np.full(inverse.shape, _SAME)
    directions = _directions(depth.camera, depth.T_world_cam)
    for plane in planes:
        z, there = plane.met(depth.T_world_cam[:3, 3], directions)
        on_it = np.divide(1.0, z, out=np.zeros_like(z), where=there)
        slant = np.maximum(np.abs(directions @ plane.normal), _FLATTEST)
        spread = np.hypot(plane.sigma_m * on_it**2 / slant, pixel)
        off = np.abs(depth.inverse - on_it) / np.hypot(depth.sigma, spread)
        near = there & (depth.inverse > 0) & (off < least)
        least[near] = off[near]
        own, its = 1.0 / depth.sigma[near] ** 2, 1.0 / spread[near] ** 2
        inverse[near] = (own * depth.inverse[near] + its * on_it[near]) / (own + its)
        sigma[near] = np.sqrt(1.0 / (own + its))
    return DepthImage(inverse, sigma, depth.camera, depth.T_world_cam)


def patches(image: DepthImage, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """About ``count`` places of a view around which its depth is that of a plane: (N, 3) world points, unit normals,
    and the points' depths in metres. Over a plane, inverse depth is linear in the pixel; so it is fitted."""
    x, y = (np.asarray(axis, np.float64) for axis in _across(image.camera))
    there = (image.inverse > 0).astype(np.float64)
    d = image.inverse * there
    terms = np.stack((there, x * there, y * there, x * x * there, x * y * there, y * y * there, d, x * d, y * d, d * d))
    size = (2 * _PATCH + 1,) * 2
    mean = np.stack([cv2.boxFilter(term, -1, size, borderType=cv2.BORDER_CONSTANT) for term in terms])
    v, u = np.nonzero((there > 0) & (mean[0] > _FILLED))
    step = max(1, len(v) // count)
    v, u = v[::step], u[::step]
    one, mx, my, xx, xy, yy, d1, dx, dy, dd = mean[:, v, u]
    A = np.stack((xx, xy, mx, xy, yy, my, mx, my, one), axis=-1).reshape(-1, 3, 3)
    b = np.stack((dx, dy, d1), axis=-1)
    normal = np.linalg.solve(A, b[..., None])[..., 0]
    off = np.sqrt(np.maximum(dd - np.einsum("nc,nc->n", normal, b), 0.0) / one)
    inverse = np.einsum("nc,nc->n", normal, np.stack((x[v, u], y[v, u], np.ones(len(v))), axis=-1))
    flat = (off < _FLAT * inverse) & (inverse > 0)
    T = image.T_world_cam
    z = 1.0 / inverse[flat]
    points = T[:3, 3] + _directions(image.camera, T)[v[flat], u[flat]] * z[:, None]
    normals = normal[flat] @ T[:3, :3].T
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True), z


def find_planes(
    points: NDArray[np.float64], normals: NDArray[np.float64], scale: float, most: int, seed: int = 0
) -> list[ScanPlane]:
    """The planes that hold most points, found one after the other; what one holds the next ones do without.

    points, normals: (N, 3) world, of which the latter have length 1 and any sign.  scale: a usual viewing distance,
    metres.  most: planes. Source: M. Fischler, R. Bolles, Random Sample Consensus, 1981.
    """
    rng = np.random.default_rng(seed)
    left = np.arange(len(points))
    found: list[ScanPlane] = []
    for _ in range(most):
        if len(left) < _LEAST_POINTS:
            break
        normal, offset, held = _best_plane(points[left], normals[left], _THICKNESS * scale, rng)
        if np.count_nonzero(held) < _LEAST_POINTS:
            break
        plane = _bounded(normal, offset, points[left[held]], scale)
        if plane is not None:
            found.append(plane)
        left = left[~held]
    return found


def _best_plane(
    points: NDArray[np.float64], normals: NDArray[np.float64], within: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], float, NDArray[np.bool_]]:
    """Normal and offset of the plane that holds most points, and which it holds."""
    chosen = rng.permutation(len(points))[:_SAMPLE]
    tried = chosen[:_TRIES]
    offsets = np.einsum("tc,tc->t", points[tried], normals[tried])
    off = np.abs(points[chosen] @ normals[tried].T - offsets) / within
    alike = np.abs(normals[chosen] @ normals[tried].T) > _ALIKE
    best = int(np.argmax((np.maximum(1.0 - off**2, 0.0) * alike).sum(axis=0)))  # nearer points count for more
    normal, offset = normals[tried[best]], float(offsets[best])
    held = np.zeros(len(points), bool)
    for _ in range(4):
        held = (np.abs(points @ normal - offset) < within) & (np.abs(normals @ normal) > _ALIKE)
        if np.count_nonzero(held) < _LEAST_POINTS:
            break
        mean = points[held].mean(axis=0)
        normal = np.linalg.eigh(np.cov((points[held] - mean).T))[1][:, 0]
        offset = float(normal @ mean)
    return normal, offset, held


def _bounded(normal: NDArray[np.float64], offset: float, points: NDArray[np.float64], scale: float) -> ScanPlane | None:
    """The plane where its points lie; None if these are few or scattered."""
    across = np.linalg.svd(normal[None])[2][1:]
    place = points @ across.T
    cell = _CELL * scale
    margin = (_GAP + _BEYOND + 1) * cell
    corner = place.min(axis=0) - margin
    shape = np.ceil((place.max(axis=0) + margin - corner) / cell).astype(int)
    index = np.floor((place - corner) / cell).astype(int)
    if shape.prod() > _MOST_CELLS:
        return None
    count = np.bincount(np.ravel_multi_index(tuple(index.T), tuple(shape)), minlength=int(shape.prod()))
    held = (count >= _LEAST_IN_CELL).reshape(shape).astype(np.uint8)
    _, labels, sizes, _ = cv2.connectedComponentsWithStats(cv2.dilate(held, np.ones((3, 3), np.uint8)))
    held *= np.isin(labels, np.flatnonzero(sizes[:, cv2.CC_STAT_AREA] >= _LEAST_PIECE)).astype(np.uint8)
    if np.count_nonzero(held) < _LEAST_CELLS:
        return None
    support = cv2.dilate(cv2.morphologyEx(held, cv2.MORPH_CLOSE, _disc(_GAP)), _disc(_BEYOND)) > 0
    spread = float(np.std(points @ normal - offset))
    return ScanPlane(normal, offset, spread, across, corner, cell, support)


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _directions(camera: Intrinsics, T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W, 3) world directions in which the pixels look, of such length that a depth is how many times they go."""
    x, y = _across(camera)
    return np.asarray(np.stack((x, y, np.ones(x.shape)), axis=-1) @ T_world_cam[:3, :3].T)


def _across(camera: Intrinsics) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(H, W) x and y of the points at depth 1 that the pixels see."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
