"""The surface that explains rays: ray marching and graph cut against plain references, and known bodies."""

import itertools

import numpy as np
import pytest
import scipy.optimize

from freeocc3d.depth.scan_points import ScanPoints
from freeocc3d.depth.tetrahedra import BEHIND, CellVotes, Tetrahedra, collect_votes, tetrahedralize
from freeocc3d.depth.watertight_surface import (
    WatertightSurface,
    build_surface,
    cut_cells,
    extract_boundary,
    measure_roundness,
)


def _crossings(space: Tetrahedra, start, way, length: float):
    """Plainly: (enters at, tetrahedron, leaves at, by its facet) of those on the way from a vertex, in order."""
    found = []
    for cell, corners in enumerate(space.corners):
        first, last, out = 0.0, length, -1
        for facet in range(4):
            a, b, c = (space.vertices[corners[(facet + k) % 4]] for k in (1, 2, 3))
            normal = np.cross(b - a, c - a)
            normal *= -np.sign(normal @ (space.vertices[corners[facet]] - a))  # outwards
            height, facing = (a - start) @ normal, way @ normal
            if abs(height) < 1e-12:  # the facet holds the vertex
                height = 0.0
            if facing > 0:
                last, out = min((last, out), (height / facing, facet))
            elif facing < 0:
                first = max(first, height / facing)
        if first < last - 1e-12:
            found.append((first, cell, last, out))
    return sorted(found)


def test_rays_vote_as_in_a_plain_march() -> None:
    rng = np.random.default_rng(0)
    space = tetrahedralize(np.concatenate((rng.normal(size=(30, 3)), rng.normal(size=(4, 3)) * 2.0)))
    rays = [(p, c) for p in range(30) for c in range(30, 34)]
    joined = [set(corners) for corners in space.corners.tolist()]
    rays = [ray for ray in rays if not any(cell.issuperset(ray) for cell in joined)]  # not along an edge
    ray_point, ray_camera = np.array(rays, np.int32).T
    sigma_m, outside = rng.uniform(0.02, 0.3, 34), len(space.corners)
    found = collect_votes(space, ray_point, ray_camera, sigma_m)
    expected = CellVotes(*(np.zeros_like(a) for a in (found.free, found.full, found.facets)))
    for point, camera in zip(ray_point, ray_camera, strict=True):
        start, sigma = space.vertices[point], sigma_m[point]
        way = space.vertices[camera] - start
        length = float(np.linalg.norm(way))
        for sign, end, votes in ((1.0, length, expected.free), (-1.0, BEHIND * sigma, expected.full)):
            cells = _crossings(space, start, sign * way / length, end)
            for (_, near, *_), (distance, far, *_) in itertools.pairwise(cells):
                free, full = (far, near) if sign > 0 else (near, far)
                facet = space.beside[free].tolist().index(full)
                expected.facets[free, facet] += 1.0 - np.exp(-0.5 * (distance / sigma) ** 2)
            _, cell, reached, facet = cells[-1] if cells else (0.0, outside, 0.0, -1)
            if reached < end - 1e-9:  # outside of all
                if cells:
                    expected.facets[cell, facet] += 1.0 - np.exp(-0.5 * (reached / sigma) ** 2)
                cell = outside
            votes[cell] += 1.0
    assert found.free.sum() == len(ray_point)  # every ray reaches its camera
    for name in ("free", "full", "facets"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)


def test_the_cut_is_as_cheap_as_linear_programming_finds_it() -> None:
    rng = np.random.default_rng(1)
    space = tetrahedralize(rng.normal(size=(25, 3)))
    count = len(space.corners) + 1
    votes = rng.integers(0, 9, (2, count)).astype(float)
    seen = CellVotes(votes[0], votes[1], rng.integers(0, 3, (count - 1, 4)).astype(float))
    shape = 1.0 - measure_roundness(space.vertices, space.corners)
    pairs, price = [], []
    for c, f in np.ndindex(count - 1, 4):
        d = space.beside[c, f]
        worse = max(shape[c, f], 0.0 if d == count - 1 else shape[d, space.beside[d].tolist().index(c)])
        pairs.append((c, d))
        price.append(seen.facets[c, f] + worse)
        if d == count - 1:
            pairs.append((d, c))
            price.append(worse)

    def cost(free) -> float:
        between = sum(p for p, (c, d) in zip(price, pairs, strict=True) if free[c] and not free[d])
        return between + seen.free[~free].sum() + seen.full[free].sum()

    # Least of: sum p_k max(x_c - x_d, 0) + sum free (1 - x) + full x, which whole numbers attain.
    A = np.zeros((len(pairs), count + len(pairs)))
    for k, (c, d) in enumerate(pairs):
        A[k, c], A[k, d], A[k, count + k] = 1.0, -1.0, -1.0
    bounds = [(0, 1)] * count + [(0, None)] * len(pairs)
    least = scipy.optimize.linprog(
        np.concatenate((seen.full - seen.free, price)), A, np.zeros(len(pairs)), bounds=bounds
    )
    assert cost(cut_cells(space, seen)) == pytest.approx(least.fun + seen.free.sum(), rel=0.005)


def test_facets_are_as_round_as_the_angle_to_their_sphere_is() -> None:
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    corners = np.array([[0, 1, 2, 3], [3, 0, 2, 1]], np.int32)
    np.testing.assert_allclose(measure_roundness(regular, corners), 1.0 / 3.0)
    flat = np.array([[0, 0, 0.01], [1, 0, 0], [-0.5, 0.8, 0], [-0.5, -0.8, 0]], float)
    found = measure_roundness(flat, corners[:1])[0]
    assert found[0] < -0.99  # the center of its sphere lies far on the other side


def _sphere(count: int) -> np.ndarray:
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + 5.0**0.5) * k
    return np.stack((np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)), axis=1)


def _closed(surface: WatertightSurface) -> bool:
    """Whether each edge is passed once in either direction by as many triangles."""
    edges = np.concatenate([surface.triangles[:, [k, (k + 1) % 3]] for k in range(3)]).tolist()
    there, back = sorted(edges), sorted(edge[::-1] for edge in edges)
    return there == back


def _volume(surface: WatertightSurface) -> float:
    corners = surface.vertices[surface.triangles].astype(float)
    return float(np.linalg.det(corners).sum() / 6.0)


def test_a_sphere_seen_from_outside_is_closed() -> None:
    rng = np.random.default_rng(0)
    ball, centers = _sphere(2000), 3.0 * _sphere(12)
    sees = np.argwhere(np.einsum("pc,kc->pk", ball, centers) > 1.2)
    noisy = ball * (1.0 + 0.005 * rng.normal(size=(len(ball), 1)))
    points = ScanPoints(noisy, np.full(len(ball), 0.005), *sees.T.astype(np.int32), cell_m=0.02)
    surface = build_surface(points, centers)
    assert _closed(surface)
    assert _volume(surface) == pytest.approx(4.0 / 3.0 * np.pi, rel=0.02)
    met = surface.met(centers[0], -centers[:1][None] / 3.0)
    assert met.times[0, 0] == pytest.approx(2.0, abs=0.03)
    assert 0.02 < met.edge_m[0, 0] < 0.4
    assert met.sigma_m[0, 0] == pytest.approx(0.005)
    assert surface.met(centers[0], centers[:1][None]).times[0, 0] == 0.0


def test_a_blank_wall_of_a_room_is_closed_between_its_edges() -> None:
    """A box of 4 x 3 x 2.5 m seen from inside. Of the wall at x = 4 m only what is near its edges was measured; there
    are a few wrong points, each along one ray, in the air."""
    rng = np.random.default_rng(0)
    size = np.array((4.0, 3.0, 2.5))
    walls = []
    for axis in range(3):
        for at in (0.0, size[axis]):
            wall = rng.uniform(0, size, (4000, 3))
            wall[:, axis] = at
            rim = np.minimum(wall, size - wall)[:, [k for k in range(3) if k != axis]].min(axis=1)
            walls.append(wall[rim < 0.3] if axis == 0 and at > 0 else wall)
    measured = np.concatenate(walls) + 0.004 * rng.normal(size=(sum(map(len, walls)), 3))
    wrong = rng.uniform(0.2, size - 0.2, (60, 3))
    centers = rng.uniform(1.0, size - 1.0, (20, 3))
    point = np.repeat(np.arange(len(measured)), 5)
    rays = np.concatenate((point, len(measured) + np.arange(60))), rng.integers(0, 20, len(point) + 60)
    points = np.concatenate((measured, wrong))
    rays = (rays[0].astype(np.int32), rays[1].astype(np.int32))
    surface = build_surface(ScanPoints(points, np.full(len(points), 0.004), *rays, cell_m=0.02), centers)
    assert _closed(surface)
    assert -_volume(surface) == pytest.approx(size.prod(), rel=0.02)  # seen from inside
    across, up = np.meshgrid(np.linspace(0.4, 2.6, 23), np.linspace(0.4, 2.1, 18))
    ways = np.stack((np.full(across.shape, 4.0), across, up), axis=-1) - centers[0]
    met = surface.met(centers[0], ways)
    assert np.median(np.abs(met.times - 1.0)) < 0.01
    assert (np.abs(met.times - 1.0) < 0.03).mean() > 0.95
    assert np.median(met.edge_m) > 0.5  # and known by its triangles to be a guess


def test_many_rays_do_not_overflow_the_solver() -> None:
    space = tetrahedralize(np.random.default_rng(2).normal(size=(30, 3)))
    count = len(space.corners) + 1
    votes = np.where(np.arange(count) % 3 == 0, 1e9, 0.0), np.where(np.arange(count) % 3 == 1, 1e9, 0.0)
    free = cut_cells(space, CellVotes(*votes, np.zeros((count - 1, 4))))
    assert free[::3].all()
    assert not free[1::3].any()
    assert len(extract_boundary(space, free)) > 0


def test_points_of_a_grid_make_a_surface_too() -> None:
    """Flat tetrahedra, ways within planes of facets, and a camera at a point: divisions by zero."""
    grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for centers in ([(2, 2, 9), (9, 3, 3), (3, 3, -4)], [(2.5, 2.5, 2.5), (1.5, 1, 2.5)], [(2, 2, 2), (1.5, 1, 2.5)]):
        sees = np.indices((len(grid), len(centers))).reshape(2, -1).astype(np.int32)
        surface = build_surface(ScanPoints(grid, np.full(len(grid), 0.01), *sees, cell_m=0.1), np.array(centers, float))
        edges = np.sort(np.concatenate([surface.triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()  # flat ones have no orientation
        assert len(edges) > 100
        assert np.isfinite(surface.normals()).all()


def test_all_cameras_at_one_place_and_a_point_far_away_do_no_harm() -> None:
    ball = np.concatenate((_sphere(1000), [(1e4, -1e4, 1e4)]))
    centers = np.array([(0.1, 0.0, 0.2)] * 4)
    sees = np.indices((len(ball), len(centers))).reshape(2, -1).astype(np.int32)
    surface = build_surface(ScanPoints(ball, np.full(len(ball), 0.005), *sees, cell_m=0.1), centers)
    assert _closed(surface)
    met = surface.met(centers[0], _sphere(50)[None] - centers[0])
    assert np.median(np.abs(met.times - 1.0)) < 0.01
