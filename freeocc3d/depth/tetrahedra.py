"""Divides space into tetrahedra between points and cameras, and collects the votes of rays about them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from ..core.compiling import njit

BEHIND = 3.0
"""Standard deviations behind a point at which space is full."""

_CERTAIN = 7.0  # standard deviations before a point at which space is certainly free
_TINY_AREA = 1e-300  # avoids division by the area of a facet without area
_ALONG = 1e-9  # sine of an angle; a ray that leaves through a facet at less may do so by rounding alone


@dataclass(frozen=True)
class Tetrahedra:
    """A division of space. vertices: (V, 3) float64 world, meters.  corners: (T, 4) int32, vertices of each
    tetrahedron.  beside: (T, 4) int32, neighbor opposite each corner; T = the cell outside all tetrahedra."""

    vertices: NDArray[np.float64]
    corners: NDArray[np.int32]
    beside: NDArray[np.int32]


@dataclass(frozen=True)
class CellVotes:
    """The votes of rays about cells.

    free, full: (T + 1,) number of rays that vote for a cell to be free, or full.  facets: (T, 4) price of a surface
    between a free tetrahedron and the cell ``beside`` it.
    """

    free: NDArray[np.float64]
    full: NDArray[np.float64]
    facets: NDArray[np.float64]


def tetrahedralize(vertices: NDArray[np.float64]) -> Tetrahedra:
    """The Delaunay tetrahedra of (V, 3) vertices: at least five, not all in one plane."""
    found = Delaunay(vertices - vertices.mean(axis=0))
    beside = np.where(found.neighbors < 0, len(found.simplices), found.neighbors)
    return Tetrahedra(vertices, found.simplices.astype(np.int32), beside.astype(np.int32))


def collect_votes(
    space: Tetrahedra,
    ray_point: NDArray[np.int32],
    ray_camera: NDArray[np.int32],
    sigma_m: NDArray[np.float64],
) -> CellVotes:
    """Each ray votes 1 for the cell of its camera to be free, and 1 for the cell ``BEHIND`` its point to be full. It
    also votes against a surface along the ray, by 1 - exp(-d² / 2 sigma²) at the distance d from the point.

    ray_point, ray_camera: (R,) vertices.  sigma_m: (V,) meters.
    """
    count = len(space.corners)
    order = np.argsort(space.corners, axis=None, kind="stable")
    around = (order // 4).astype(np.int32)
    first = np.searchsorted(space.corners.reshape(-1)[order], np.arange(len(space.vertices) + 1))
    found = CellVotes(np.zeros(count + 1), np.zeros(count + 1), np.zeros((count, 4)))
    vertices = space.vertices - space.vertices.mean(axis=0)
    _march(
        vertices, space.corners, space.beside, compute_facet_planes(vertices, space.corners), first, around, ray_point,
        ray_camera, sigma_m, found.free, found.full, found.facets,
    )  # fmt: skip
    return found


@njit(cache=True, nogil=True)
def compute_facet_planes(vertices, corners):  # type: ignore[no-untyped-def]
    """(T, 4, 4) unit outward normal of each facet (opposite a corner), and its offset along the normal."""
    out = np.empty((*corners.shape, 4))
    for cell in range(len(corners)):
        for facet in range(4):
            a = vertices[corners[cell, (facet + 1) & 3]]
            u, v = vertices[corners[cell, (facet + 2) & 3]] - a, vertices[corners[cell, (facet + 3) & 3]] - a
            normal = np.cross(u, v)
            normal /= max(np.sqrt((normal * normal).sum()), _TINY_AREA)
            if (normal * (vertices[corners[cell, facet]] - a)).sum() > 0.0:
                normal = -normal
            out[cell, facet, :3] = normal
            out[cell, facet, 3] = (normal * a).sum()
    return out


@njit(cache=True, nogil=True)
def _march(vertices, corners, beside, facets, first, around, ray_point, ray_camera, sigma_m, free, full, prices):  # type: ignore[no-untyped-def]
    way = np.empty(3)
    for ray in range(len(ray_point)):
        point, camera = ray_point[ray], ray_camera[ray]
        start, sigma = vertices[point], sigma_m[point]
        way[:] = vertices[camera] - start
        length = np.sqrt((way * way).sum())
        if length == 0.0:
            continue
        way /= length
        cell, out = _first_cell(corners, facets, first, around, point, way)
        free[_walk(corners, beside, facets, cell, out, start, way, length, camera, sigma, prices)] += 1.0
        way *= -1.0
        cell, out = _first_cell(corners, facets, first, around, point, way)
        full[_walk(corners, beside, facets, cell, out, start, way, BEHIND * sigma, -1, sigma, prices)] += 1.0


@njit(cache=True, nogil=True)
def _walk(corners, beside, facets, cell, out, start, way, length, camera, sigma, prices):  # type: ignore[no-untyped-def]
    """Walk along a ray from a corner of a cell, out by the opposite facet and on, until a cell holds the ``camera``
    (-1: walk away from the camera) or the ``length`` is reached. Returns that cell. Adds prices to the crossed facets,
    on the camera's side."""
    outside = len(corners)
    distance = _distance(facets, cell, out, start, way) if cell < outside else 0.0
    for _ in range(outside):  # no ray meets a tetrahedron twice
        if cell == outside or distance >= length:
            break
        if camera in (corners[cell, 0], corners[cell, 1], corners[cell, 2], corners[cell, 3]):
            break
        after, back = beside[cell, out], 0
        price = 1.0 - np.exp(-0.5 * (distance / sigma) ** 2) if distance < _CERTAIN * sigma else 1.0
        if camera < 0:
            prices[cell, out] += price
        if after < outside:
            while beside[after, back] != cell:
                back += 1
            if camera >= 0:
                prices[after, back] += price
            out, distance = _way_out(facets, after, back, start, way)
        cell = after
    return cell


@njit(cache=True, nogil=True)
def _way_out(facets, cell, entered, start, way):  # type: ignore[no-untyped-def]
    """The facet by which a ray leaves a tetrahedron, and its distance: the nearest facet besides the entered one. Such
    a facet exists even if, by rounding, the ray misses the tetrahedron; a comparison of edge sides would not find
    it."""
    out, nearest = (entered + 1) & 3, np.inf
    for facet in range(4):
        if facet != entered and _leaving(facets, cell, facet, way) > 0.0:
            distance = _distance(facets, cell, facet, start, way)
            if distance < nearest:
                out, nearest = facet, distance
    return out, nearest


@njit(cache=True, nogil=True)
def _first_cell(corners, facets, first, around, point, way):  # type: ignore[no-untyped-def]
    """The cell at a vertex that a ray enters, and the corner of the cell that the vertex is. If a ray runs along a
    facet, rounding may place it outside the tetrahedra on both sides; the one that it leaves least is taken."""
    best, which, least = len(corners), 0, _ALONG
    for row in range(first[point], first[point + 1]):
        cell = around[row]
        worst, own = -np.inf, 0
        for k in range(4):
            if corners[cell, k] == point:
                own = k
            else:
                worst = max(worst, _leaving(facets, cell, k, way))
        if worst < least:
            best, which, least = cell, own, worst
    return best, which


@njit(cache=True, nogil=True)
def _leaving(facets, cell, facet, way):  # type: ignore[no-untyped-def]
    """Sine of the angle at which a ray leaves a tetrahedron through a facet's plane; negative if it enters."""
    return facets[cell, facet, 0] * way[0] + facets[cell, facet, 1] * way[1] + facets[cell, facet, 2] * way[2]


@njit(cache=True, nogil=True)
def _distance(facets, cell, facet, start, way):  # type: ignore[no-untyped-def]
    """Distance along a ray to the facet that it leaves by; 0 if the ray lies in its plane, as in a flat tetrahedron."""
    leaving = _leaving(facets, cell, facet, way)
    if leaving == 0.0:
        return 0.0
    height = facets[cell, facet, 3]  # a loop, because slices cost more for reference counts
    for k in range(3):
        height -= facets[cell, facet, k] * start[k]
    return height / leaving
