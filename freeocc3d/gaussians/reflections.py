"""Finds what a mirror shows: surface behind a plane, seen through an opening of it, that is the image of what is in
front.

A flat mirror is as good as a window to all frames: what they see in it stays in one place, behind the wall. But it is
the image of the room, p' = p - 2 (n^T p - d) n. So for each large plane, the points behind it that are seen from in
front of it are grouped by where their rays cross it. A group is a reflection if most of its points have a point of the
room at their image, whose normal is the image of theirs. Points whose normals lie along the plane do not count: a floor
and a side wall that go on behind a door are their own images.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

_BINS, _OFFSET_M = 8, 0.1
"""Bins of each coordinate of a normal from 0 to 1, and of distances, in which points vote for planes."""

_LEAST_PLANE, _MOST_PLANES = 0.01, 12
"""Least share of all points that a plane needs, and number of planes to look behind."""

_BEHIND_M = 0.15
"""Least distance behind a plane, meters: a picture's frame and a wall's noise are nearer."""

_ALONG = 0.35
"""Cosine between the normals of a point and of the plane, below which the point may be its own image."""

_NEAR, _ALIKE = 2.0, 0.8
"""Distance in spacings, and cosine of the normals, within which a point is at the image of another."""

_CELL_M, _FEWEST, _SHARE = 0.1, 100, 0.5
"""Cells of a plane that join crossing rays to a group; points of a group that count; and their share with an image."""

_FRAMED = 0.6
"""Share of the cells around a group that must hold surface of the plane: a mirror hangs on a wall or stands in one."""

_SHIFTS_M = np.arange(-0.06, 0.07, 0.02)
"""Distances of a mirror from the plane of its wall that are tried."""


def find_reflections(
    points: NDArray[np.float64], normals: NDArray[np.float64], cameras: NDArray[np.float64], spacing: float
) -> NDArray[np.bool_]:
    """(N,) whether each point is a reflection.

    points: (N, 3) world, meters.  normals: (N, 3) unit, toward the cameras.  cameras: (N, 3) from where each is seen
    best.  spacing: usual distance of neighbors on a surface, meters.
    """
    found = np.zeros(len(points), bool)
    if len(points) < _FEWEST:
        return found
    tree = None
    for n, d in _find_planes(points, normals):
        height, eye = points @ n - d, cameras @ n - d
        behind = np.flatnonzero((height < -_BEHIND_M) & (eye > 0) & ~found)
        telling = np.abs(normals[behind] @ n) > _ALONG
        if np.count_nonzero(telling) < _FEWEST:
            continue
        share = (eye[behind] / (eye[behind] - height[behind]))[:, None]
        crossing = cameras[behind] + share * (points[behind] - cameras[behind])
        group, framed = _group_crossings(crossing, points[np.abs(height) < _BEHIND_M], n)
        asked = np.flatnonzero(telling & framed[group])
        if len(asked) < _FEWEST:
            continue
        tree = cKDTree(points) if tree is None else tree
        shown = [_have_images(points, normals, tree, behind[asked], n, d + off, spacing) for off in _SHIFTS_M]
        best = shown[int(np.argmax([each.sum() for each in shown]))]
        counts, images = (np.bincount(group[asked], each, minlength=len(framed)) for each in (None, best))
        found[behind[((counts >= _FEWEST) & (images > _SHARE * counts))[group]]] = True
    return found


def _find_planes(points: NDArray[np.float64], normals: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], float]]:
    """The planes n^T p = d that most points lie on, as (n, d)."""
    direction = np.rint(_BINS * normals).astype(np.int64)
    middle = np.unique(direction, axis=0, return_inverse=True)[1].ravel()
    mean = np.stack([np.bincount(middle, normals[:, i]) for i in range(3)], axis=1)
    mean = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    offset = (points * mean[middle]).sum(axis=1)
    votes = np.stack((middle, np.floor(offset / _OFFSET_M).astype(np.int64)), axis=1)
    kinds, plane, count = np.unique(votes, axis=0, return_inverse=True, return_counts=True)
    planes: list[tuple[NDArray[np.float64], float]] = []
    for each in np.argsort(-count)[: 3 * _MOST_PLANES].tolist():
        n, d = mean[kinds[each, 0]], float(np.median(offset[plane.ravel() == each]))
        known = any(n @ other > _ALIKE and abs(d - at) < _BEHIND_M for other, at in planes)
        if count[each] >= _LEAST_PLANE * len(points) and not known and len(planes) < _MOST_PLANES:
            planes.append((n, d))
    return planes


def _group_crossings(
    crossing: NDArray[np.float64], surface: NDArray[np.float64], n: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Returns the group of each of the (M, 3) places where rays cross a plane, and whether each group is an opening of
    the plane: most of what surrounds it is surface. surface: (S, 3) points on the plane with the normal n."""
    across = np.linalg.svd(n[None])[2][1:].T
    every = np.floor(np.concatenate((crossing, surface)) @ across / _CELL_M).astype(np.int64)
    low = crossing @ across / _CELL_M
    first, last = np.floor(low.min(axis=0)).astype(np.int64) - 1, np.floor(low.max(axis=0)).astype(np.int64) + 1
    cells = np.clip(every, first, last) - first
    inside = ((every >= first) & (every <= last)).all(axis=1)
    crossed, covered = np.zeros((2, *(last - first + 1)), bool)
    own = cells[: len(crossing)]
    crossed[tuple(own.T)] = True
    covered[tuple(cells[len(crossing) :][inside[len(crossing) :]].T)] = True
    label, count = ndimage.label(crossed, np.ones((3, 3)))
    framed = np.zeros(count + 1, bool)
    for k in range(1, count + 1):
        ring = ndimage.binary_dilation(label == k, np.ones((3, 3))) & (label != k)
        framed[k] = covered[ring].mean() > _FRAMED
    return label[tuple(own.T)].astype(np.int64), framed


def _have_images(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    tree: cKDTree,
    rows: NDArray[np.int64],
    n: NDArray[np.float64],
    d: float,
    spacing: float,
) -> NDArray[np.bool_]:
    """(M,) whether the images of some points in the plane n^T p = d lie on the surface of the others."""
    image = points[rows] - 2 * (points[rows] @ n - d)[:, None] * n
    turned = normals[rows] - 2 * (normals[rows] @ n)[:, None] * n
    off, nearest = tree.query(image, distance_upper_bound=_NEAR * spacing, workers=-1)
    near = np.isfinite(off)
    alike = (normals[np.where(near, nearest, 0)] * turned).sum(axis=1) > _ALIKE
    return np.asarray(near & alike)
