"""Space cut into tetrahedra whose corners are points and cameras, and what the rays between these say of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import Delaunay

BEHIND = 3.0  # standard deviations behind a point, where there is matter


@dataclass(frozen=True)
class Tetrahedra:
    """vertices: (V, 3) float64.  corners: (T, 4) int32 vertices.  beside: (T, 4) int32, the cell that shares all other
    corners: a tetrahedron, or what is outside of all, the cell T."""

    vertices: NDArray[np.float64]
    corners: NDArray[np.int32]
    beside: NDArray[np.int32]


@dataclass(frozen=True)
class Evidence:
    """What rays say of cells.

    free, full: (T + 1,) rays that say that a cell is.  facets: (T, 4) price of a surface between a free tetrahedron and
    the cell ``beside`` it.
    """

    free: NDArray[np.float64]
    full: NDArray[np.float64]
    facets: NDArray[np.float64]


def tetrahedra(vertices: NDArray[np.float64]) -> Tetrahedra:
    """The Delaunay tetrahedra of (V, 3) vertices, of which there must be five that do not lie in a plane."""
    found = Delaunay(vertices - vertices.mean(axis=0))
    beside = np.where(found.neighbors < 0, len(found.simplices), found.neighbors)
    return Tetrahedra(vertices, found.simplices.astype(np.int32), beside.astype(np.int32))


def evidence(
    space: Tetrahedra,
    ray_point: NDArray[np.int32],
    ray_camera: NDArray[np.int32],
    sigma_m: NDArray[np.float64],
) -> Evidence:
    """Each ray votes with one for the cell of its camera to be free, for the one ``BEHIND`` its point to be full, and
    against a surface on its way, less so the nearer to its point: 1 - exp(-d² / 2 sigma²) at the distance d.

    ray_point, ray_camera: (R,) vertices.  sigma_m: (V,) metres.
    """
    count = len(space.corners)
    order = np.argsort(space.corners, axis=None, kind="stable")
    around = (order // 4).astype(np.int32)
    first = np.searchsorted(space.corners.reshape(-1)[order], np.arange(len(space.vertices) + 1))
    found = Evidence(np.zeros(count + 1), np.zeros(count + 1), np.zeros((count, 4)))
    centred = space.vertices - space.vertices.mean(axis=0)
    _march(
        centred, space.corners, space.beside, first, around, ray_point, ray_camera, sigma_m,
        found.free, found.full, found.facets,
    )  # fmt: skip
    return found


@njit(cache=True, nogil=True)
def _march(vertices, corners, beside, first, around, ray_point, ray_camera, sigma_m, free, full, facets):  # type: ignore[no-untyped-def]
    way = np.empty(3)
    for ray in range(len(ray_point)):
        point, camera = ray_point[ray], ray_camera[ray]
        length = 0.0
        for c in range(3):
            way[c] = vertices[camera, c] - vertices[point, c]
            length += way[c] ** 2
        length = np.sqrt(length)
        sigma = sigma_m[point]
        way /= length
        last = _walk(vertices, corners, beside, first, around, point, way, length, camera, sigma, facets)
        free[last] += 1.0
        way *= -1.0
        last = _walk(vertices, corners, beside, first, around, point, way, BEHIND * sigma, -1, sigma, facets)
        full[last] += 1.0


@njit(cache=True, nogil=True)
def _walk(vertices, corners, beside, first, around, point, way, length, camera, sigma, facets):  # type: ignore[no-untyped-def]
    """From a vertex through cells until one holds the ``camera`` (-1: it is behind), or the ``length`` is gone; returns
    the last one. Prices go to the facets that are crossed, as seen from the camera's side."""
    outside = len(corners)
    here, out = _first_cell(vertices, corners, first, around, point, way)
    for _ in range(outside):  # no ray meets a tetrahedron twice
        if here == outside:
            break
        for k in range(4):
            if corners[here, k] == camera:
                return here
        distance = _distance(vertices, corners, here, out, point, way)[0]
        if distance >= length:
            break
        after, back = beside[here, out], -1
        if after < outside:
            for k in range(4):
                if beside[after, k] == here:
                    back = k
        price = 1.0 - np.exp(-0.5 * (distance / sigma) ** 2)
        if camera < 0:
            facets[here, out] += price
        elif after < outside:
            facets[after, back] += price
        here = after
        if here < outside:
            out = _way_out(vertices, corners, here, back, point, way)
    return here


@njit(cache=True, nogil=True)
def _way_out(vertices, corners, cell, entered, point, way):  # type: ignore[no-untyped-def]
    """By which facet a way leaves a tetrahedron: the nearest of those that it does not enter by. That there is one even
    where rounding says that the way misses the tetrahedron is why sides of edges are not compared instead."""
    out, nearest = (entered + 1) & 3, np.inf
    for facet in range(4):
        if facet != entered:
            distance, leaving = _distance(vertices, corners, cell, facet, point, way)
            if leaving > 0.0 and distance < nearest:
                out, nearest = facet, distance
    return out


@njit(cache=True, nogil=True)
def _first_cell(vertices, corners, first, around, point, way):  # type: ignore[no-untyped-def]
    """The cell around a vertex into which a way goes, and which of its corners the vertex is. Of a way along a facet
    rounding may say that it leaves the tetrahedra on both sides: where it does so least, it goes."""
    best, which, least = len(corners), -1, 1e-9
    for row in range(first[point], first[point + 1]):
        cell = around[row]
        worst, own = -np.inf, -1
        for k in range(4):
            if corners[cell, k] == point:
                own = k
            else:
                worst = max(worst, _distance(vertices, corners, cell, k, point, way)[1])
        if worst < least:
            best, which, least = cell, own, worst
    return best, which


@njit(cache=True, nogil=True)
def _distance(vertices, corners, cell, facet, point, way):  # type: ignore[no-untyped-def]
    """How far the way from a vertex is to the plane of a facet (opposite that corner), and the sine by which it leaves
    the tetrahedron there, negative if it enters."""
    a, b, c = (vertices[corners[cell, (facet + 1) & 3]], vertices[corners[cell, (facet + 2) & 3]],
               vertices[corners[cell, (facet + 3) & 3]])  # fmt: skip
    apex, start = vertices[corners[cell, facet]], vertices[point]
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    size = np.sqrt(nx * nx + ny * ny + nz * nz)
    if (apex[0] - a[0]) * nx + (apex[1] - a[1]) * ny + (apex[2] - a[2]) * nz > 0.0:
        size = -size  # normals point outwards
    facing = way[0] * nx + way[1] * ny + way[2] * nz
    if size == 0.0 or facing == 0.0:
        return np.inf, 0.0
    height = (a[0] - start[0]) * nx + (a[1] - start[1]) * ny + (a[2] - start[2]) * nz
    return height / facing, facing / size
