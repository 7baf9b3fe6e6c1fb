"""Builds the closed surface that explains a scan's rays best: it separates free space from matter behind points.

Sources: P. Labatut, J.-P. Pons, R. Keriven, Robust and Efficient Surface Reconstruction from Range Data, CGF 2009 (the
energy, its cut, the quality of facets); M. Jancosek, T. Pajdla, Multi-View Reconstruction Preserving Weakly-Supported
Surfaces, CVPR 2011 (such a cut also finds surfaces with few measurements).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from ..core.compiling import njit
from .scan_points import ScanPoints
from .tetrahedra import CellVotes, Tetrahedra, collect_votes, tetrahedralize

SIDE_BY_SIDE = 6.0
"""Cells: triangles with longer edges span gaps in the measurements."""

_SOFT = 3.0  # standard deviations around a point within which rays may cross the surface
_QUALITY = 1.0  # weight of the worst facet shape, in rays per side
_STEPS = 50.0  # integer flow units per ray
_LARGEST = (1 << 30) - 1  # the solver adds two capacities in 32 bits
_TINY = 1e-12  # largest length of the normal of a triangle without area


@dataclass(frozen=True)
class RayHits:
    """Per ray. times: ray parameter at the surface, 0 = no hit. Of the triangle that is hit: edge_m, its longest edge,
    meters; sigma_m, the median standard deviation of its corners, meters; cosine, between its normal and the ray."""

    times: NDArray[np.float32]
    edge_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    cosine: NDArray[np.float32]


@dataclass(frozen=True)
class WatertightSurface:
    """A closed surface. vertices: (V, 3) float32 world, meters.  sigma_m: (V,) float32 standard deviations, meters.
    triangles: (F, 3) int32.  cell_m: distance of adjacent measured vertices, meters."""

    vertices: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    triangles: NDArray[np.int32]
    cell_m: float

    def met(self, origin: NDArray[np.float64], directions: NDArray[np.float64]) -> RayHits:
        """The first hits of rays from ``origin`` along (H, W, 3) directions."""
        from open3d import core

        rays = np.concatenate((np.broadcast_to(origin, directions.shape), directions), axis=-1).astype(np.float32)
        found = self._scene.cast_rays(core.Tensor(rays), nthreads=1)
        times = found["t_hit"].numpy()
        hit = np.isfinite(times)
        triangle = np.where(hit, found["primitive_ids"].numpy(), 0).astype(np.int64)
        if not hit.any():
            return RayHits(*(np.zeros_like(times) for _ in range(4)))
        edge_m, sigma_m = self._of_triangles
        normals = found["primitive_normals"].numpy()
        lengths = np.linalg.norm(normals, axis=-1) * np.linalg.norm(directions, axis=-1)
        cosine = (np.abs((normals * directions).sum(axis=-1)) / np.maximum(lengths, _TINY)).astype(np.float32)
        return RayHits(*(np.where(hit, a, 0.0) for a in (times, edge_m[triangle], sigma_m[triangle], cosine)))

    def normals(self) -> NDArray[np.float64]:
        """(N, 3) normals of the triangles between adjacent measured vertices."""
        near = self._of_triangles[0] < SIDE_BY_SIDE * self.cell_m
        a, b, c = np.moveaxis(self.vertices[self.triangles[near]].astype(np.float64), 1, 0)
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray((normals / np.maximum(length, _TINY))[length[:, 0] > _TINY])

    @cached_property
    def _scene(self) -> Any:
        from open3d import core, t

        scene = t.geometry.RaycastingScene()
        if len(self.triangles):
            scene.add_triangles(core.Tensor(self.vertices), core.Tensor(self.triangles.astype(np.uint32)))
        return scene

    @cached_property
    def _of_triangles(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        corners = self.vertices[self.triangles]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        return edges, np.median(self.sigma_m[self.triangles], axis=1)


def build_surface(points: ScanPoints, centers: NDArray[np.float64]) -> WatertightSurface:
    """Build the surface of points measured from cameras at (C, 3) ``centers``. Triangles are counter-clockwise as seen
    from the free side. Needs at least five points and centers that do not lie in one plane."""
    count = len(points.points)
    space = tetrahedralize(np.concatenate((points.points, centers)))
    soft = np.maximum(_SOFT * points.sigma_m, 0.5 * points.cell_m)
    seen = collect_votes(space, points.ray_point, (points.ray_camera + count).astype(np.int32), soft)
    free = cut_cells(space, seen)
    sigma_m = np.concatenate((points.sigma_m, np.zeros(len(centers))))
    return WatertightSurface(
        space.vertices.astype(np.float32), sigma_m.astype(np.float32), extract_boundary(space, free), points.cell_m
    )


def cut_cells(space: Tetrahedra, seen: CellVotes) -> NDArray[np.bool_]:
    """(T + 1,) whether each cell is free, by the minimum cut: it has the smallest cost of facets between free and full
    cells and of cells that contradict their rays."""
    outside = len(space.corners)
    round_ = measure_roundness(space.vertices - space.vertices.mean(axis=0), space.corners)
    cell, facet = np.nonzero(space.beside < outside)
    after = space.beside[cell, facet]
    back = np.argmax(space.beside[after] == cell[:, None], axis=1)
    shape = 1.0 - round_
    shape[cell, facet] = np.maximum(shape[cell, facet], shape[after, back])
    rim, rim_facet = np.nonzero(space.beside == outside)
    surplus = seen.free - seen.full  # votes for both cost the same in every cut
    source, sink = np.maximum(surplus, 0.0), np.maximum(-surplus, 0.0)
    cells = np.arange(outside + 1)
    rows = np.concatenate(
        (np.repeat(cells[:-1], 4), np.full(len(rim), outside), np.full(len(cells), outside + 1), cells)
    )
    columns = np.concatenate((space.beside.reshape(-1), rim, cells, np.full(len(cells), outside + 2)))
    inner = seen.facets + _QUALITY * shape
    prices = np.concatenate((inner.reshape(-1), _QUALITY * shape[rim, rim_facet], source, sink))
    steps = min(_STEPS, _LARGEST / max(source.sum(), sink.sum(), inner.max(), 1.0))
    size = outside + 3
    capacity = coo_matrix((np.rint(prices * steps).astype(np.int32), (rows, columns)), shape=(size, size)).tocsr()
    left = capacity - maximum_flow(capacity, outside + 1, outside + 2).flow
    left.eliminate_zeros()
    free = np.zeros(size, bool)
    free[breadth_first_order(left, outside + 1, return_predecessors=False)] = True
    return free[:-2]


def extract_boundary(space: Tetrahedra, free: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(F, 3) vertices of the facets between free and full cells, counter-clockwise as seen from the free side."""
    outside = len(space.corners)
    differ = free[:-1, None] != free[space.beside]
    cell, facet = np.nonzero(differ & (free[:-1, None] | (space.beside == outside)))  # each facet once
    triangles = np.stack([space.corners[cell, (facet + k) & 3] for k in (1, 2, 3)], axis=1)
    a, b, c = (space.vertices[triangles[:, k]] for k in range(3))
    side = np.einsum("fc,fc->f", np.cross(b - a, c - a), space.vertices[space.corners[cell, facet]] - a)
    return np.where(((side > 0) == free[cell])[:, None], triangles, triangles[:, ::-1]).astype(np.int32)


@njit(cache=True, nogil=True)
def measure_roundness(vertices, corners):  # type: ignore[no-untyped-def]
    """(T, 4) cosine between each facet (opposite a corner) and the sphere through the corners, -1…1. Low if the
    tetrahedron is a needle or a sliver at that facet."""
    out = np.empty(corners.shape)
    for cell in range(len(corners)):
        a = vertices[corners[cell, 0]]
        u, v, w = vertices[corners[cell, 1]] - a, vertices[corners[cell, 2]] - a, vertices[corners[cell, 3]] - a
        vw, wu, uv = np.cross(v, w), np.cross(w, u), np.cross(u, v)
        volume = 2.0 * (u * vw).sum()
        if volume == 0.0:
            out[cell] = -1.0
            continue
        to_center = ((u * u).sum() * vw + (v * v).sum() * wu + (w * w).sum() * uv) / volume
        radius = np.sqrt((to_center * to_center).sum())
        for facet in range(4):
            p = vertices[corners[cell, (facet + 1) & 3]]
            across = vertices[corners[cell, (facet + 2) & 3]] - p
            normal = np.cross(across, vertices[corners[cell, (facet + 3) & 3]] - p)
            height = (normal * (a + to_center - p)).sum() / np.sqrt((normal * normal).sum())
            if (normal * (vertices[corners[cell, facet]] - p)).sum() < 0.0:
                height = -height
            out[cell, facet] = min(max(height / radius, -1.0), 1.0)
    return out
