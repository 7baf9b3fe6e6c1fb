"""The surface of a map as small discs, and how neighboring discs meet: level, over an edge, in a corner, or at a step.

The Gaussians are such discs: denoised, evenly spaced at half a voxel, and colored. So the surface of things is known
more finely than by voxels, and a room has some ten thousand discs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.spatial import KDTree

from ...core.transforms import quats_to_rotations, transform
from ...language.encoders.color import rgb_to_lab
from ...storage.saved_map import SavedMap

_NEIGHBORS = 8  # on a square grid of spacing s the farthest of 8 neighbors has distance s * sqrt(2)
_REACH = 1.75  # spacings: the 8 neighbors, which are up to 1.41 spacings away, despite uneven spacing
_ALIKE = 0.7  # cosine of normals of one surface: 45 degrees


@dataclass(frozen=True)
class Surfels:
    """N discs in a frame with z up and the floor at z = 0, meters.

    points: (N, 3) centers.  normals: (N, 3) unit, toward the cameras, averaged over neighbors of the same surface.
    lab: (N, 3) CIELAB colors.  pairs: (E, 2) neighbors.  spacing: usual distance of neighbors, meters.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    lab: NDArray[np.float64]
    pairs: NDArray[np.int64]
    spacing: float

    def __len__(self) -> int:
        return len(self.points)

    def concavities(self, pairs: NDArray[np.int64]) -> NDArray[np.float64]:
        """(P,) how concave the surface is between pairs of neighbors: the difference of their normals along the line
        between them. At an edge where the normals turn by an angle a, it is 2 sin(a / 2), with a positive sign in a
        corner and a negative sign around an edge that sticks out; 0 on a plane, whatever the noise along it.

        Source of the criterion: S. Stein et al., Object Partitioning Using Local Convexity, CVPR 2014.
        """
        line, turn = (values[pairs[:, 1]] - values[pairs[:, 0]] for values in (self.points, self.normals))
        return np.asarray(-(turn * line).sum(axis=1) / np.maximum(np.linalg.norm(line, axis=1), 1e-9))

    def steps(self, pairs: NDArray[np.int64]) -> NDArray[np.float64]:
        """(P,) how far the neighbors' planes miss each other's centers, in spacings; 0 where the normals differ by more
        than 45 degrees."""
        a, b = pairs.T
        line = self.points[b] - self.points[a]
        off = np.maximum(*(np.abs((line * self.normals[side]).sum(axis=1)) for side in (a, b)))
        alike = (self.normals[a] * self.normals[b]).sum(axis=1) > _ALIKE
        return np.asarray(np.where(alike, off / self.spacing, 0.0))


def take_surfels(scan_map: SavedMap) -> Surfels:
    """Makes the surfels of a map from its Gaussians."""
    gaussians = scan_map.gaussians
    T_gravity_map = scan_map.T_gravity_map
    points = transform(T_gravity_map, gaussians.means.astype(np.float64))
    thin = np.argmin(gaussians.scales, axis=1)
    normals = quats_to_rotations(gaussians.quats_wxyz)[np.arange(len(thin)), :, thin].astype(np.float64)
    cameras = scan_map.trajectory.T_world_keyframe[gaussians.anchor_keyframe, :3, 3]
    toward = ((cameras - gaussians.means) * normals).sum(axis=1)
    normals = (normals * np.where(toward < 0, -1.0, 1.0)[:, None]) @ T_gravity_map[:3, :3].T
    return join_neighbors(points, normals, rgb_to_lab(gaussians.colors.astype(np.float64)))


def join_neighbors(points: NDArray[np.float64], normals: NDArray[np.float64], lab: NDArray[np.float64]) -> Surfels:
    """Makes surfels of (N, 3) centers, unit normals and CIELAB colors: finds the neighbors and averages the normals."""
    tree = KDTree(points)
    count = min(_NEIGHBORS + 1, len(points))
    spacing = float(np.median(tree.query(points, k=[count])[0])) / np.sqrt(2.0) or 1.0
    pairs = tree.query_pairs(_REACH * spacing, output_type="ndarray").astype(np.int64)
    return Surfels(points, _averaged(normals, pairs), lab, pairs, spacing)


def _averaged(normals: NDArray[np.float64], pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """(N, 3) means of each normal and those of its neighbors that differ by less than 45 degrees."""
    a, b = pairs[(normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1) > _ALIKE].T
    joins = coo_array((np.ones(2 * len(a)), (np.append(a, b), np.append(b, a))), shape=(len(normals), len(normals)))
    mean = normals + joins @ normals
    return np.asarray(mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9))
