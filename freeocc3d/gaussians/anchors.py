"""Lifts keyframe depth to Gaussians: one per cell of the surface, ray-aligned, anchored to a keyframe.

Dense pixels are not Gaussians of their own: a wall seen by a hundred keyframes would be a hundred layers thick, which
saturates the occupancy product and fills memory. The measurements of a cell are averaged, weighted by their depth
uncertainty; the averages are moved to where all depth images together have the surface (``fusion``) and averaged by
cells again; and what results is anchored to the keyframe that measures it best. The number of Gaussians grows with the
surface, not with the frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import ConfigError
from ..geometry import back_project, depth_sigma, invert, multiply_quats, rotations_to_quats, transform
from ..registry import require_positive
from ..types import Frame, Gaussians, Intrinsics
from . import fusion

_CELLS_PER_AXIS = 1 << 20  # cells on either side of the world's origin, along each axis
_ROWS_BEFORE_MERGE = 2_000_000


@dataclass(frozen=True)
class Options:
    """Layer 2: how keyframe depth becomes Gaussians."""

    cell_size: float | None = None
    """Edge of the cells that hold one Gaussian each, metres; null = half the voxel size."""
    pixel_stride: int | None = None
    """Every n-th pixel of a keyframe, in both directions, is lifted; null = as many as leave 320 columns, more where
    cells are small."""
    denoise: bool = True
    """Move the cells' points to where all keyframes' depth images together have the surface, and leave out those that
    most see through: adds 3 to 9 points of IoU on the shipped captures and halves the number of Gaussians."""
    coverage: float = 0.7
    """s_perp over the spacing of the Gaussians, which is the cell's edge or, where that is greater, the footprint of a
    pixel on the surface. At 0.7 a flat wall reaches alpha = 0.5 at 0.6 voxels from its surface: a voxel's centre is
    within 0.5 voxels of a surface through it where that is along the lattice, and up to 0.87 where it is oblique."""
    uncertainty: float = 0.0
    """Standard deviations of an anchor's averaged depth that are added (in quadrature) to that spacing. Uncertain
    surfaces, those that few keyframes saw from afar, come out thicker: 1 loses two to eight points of IoU on the house
    captures and gains 0.3 on the kitchen."""
    gamma: float = 1.0
    """Elongation along the viewing ray, s_par = gamma * s_perp; at 1 a Gaussian is a sphere, which measures best on the
    shipped captures (0.6 and 1.5 lose one to five points of IoU on the kitchen)."""
    opacity: float = 0.9
    """Opacity of a new Gaussian, 0…1: where fitting starts, and its weight when voxels take up features and colours;
    alpha does not depend on it."""
    initialisation: str = "ray_aligned"
    """"ray_aligned": as above, the paper's geometry-aware initialisation; "isotropic": spheres of the mean distance to
    the three nearest Gaussians, as in 3D Gaussian splatting (for comparison)."""
    edge: float = 0.05
    """Pixels whose depth differs from a neighbour's by more than this share of it are dropped: at an edge the sensor
    reports depths that belong to neither side."""
    min_pixels: int = 2
    """Measurements that a cell needs, unless it is too small to hold so many."""

    def __post_init__(self) -> None:
        require_positive(self, "cell_size", "pixel_stride", "coverage", "gamma", "opacity", "edge", "min_pixels")
        if self.opacity > 1:
            raise ConfigError(f"'opacity' must be at most 1, got {self.opacity}.")
        if self.uncertainty < 0:
            raise ConfigError(f"'uncertainty' must not be negative, got {self.uncertainty}.")
        if self.initialisation not in ("ray_aligned", "isotropic"):
            raise ConfigError(f"'initialisation' must be ray_aligned or isotropic, got '{self.initialisation}'.")


def away_from_edges(depth_m: NDArray[np.float32], edge: float) -> NDArray[np.bool_]:
    """(H, W) pixels with a depth, none of whose four neighbours differs by more than ``edge`` times its depth."""
    good = depth_m > 0
    for axis in (0, 1):
        near, far = np.take(depth_m, range(depth_m.shape[axis] - 1), axis), np.delete(depth_m, 0, axis)
        jump = (np.abs(near - far) > edge * np.minimum(near, far)) & (near > 0) & (far > 0)
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 1)
        padded = np.pad(jump, pad)
        good &= ~np.take(padded, range(depth_m.shape[axis]), axis) & ~np.delete(padded, 0, axis)
    return good


@dataclass
class _Cells:
    """Sums over the measurements of each cell; rows are cells, ``key`` is ascending."""

    key: NDArray[np.int64]
    weight: NDArray[Any]
    position: NDArray[Any]  # (n, 3) weighted sum, world
    color: NDArray[Any]  # (n, 3) weighted sum
    pixels: NDArray[np.int64]
    best_weight: NDArray[Any]  # of the keyframe that measured the cell best
    best_keyframe: NDArray[np.int32]
    best_footprint: NDArray[np.float32]  # spacing of that keyframe's measurements on the surface, metres

    @property
    def points(self) -> NDArray[np.float64]:
        """(n, 3) mean positions, world."""
        return np.asarray(self.position / self.weight[:, None])

    def __getitem__(self, rows: NDArray[np.bool_]) -> _Cells:
        return _Cells(*(getattr(self, field.name)[rows] for field in fields(self)))

    def merged(self) -> _Cells:
        """Rows of the same cell summed. The result does not depend on the order of rows but to rounding."""
        key, row = np.unique(self.key, return_inverse=True)
        order = np.lexsort((-self.best_keyframe, self.best_weight, row))
        best = order[
            np.flatnonzero(np.diff(row[order], append=-1))
        ]  # last of each cell: largest weight, first keyframe
        return _Cells(
            key,
            np.bincount(row, self.weight),
            np.stack([np.bincount(row, self.position[:, i]) for i in range(3)], axis=1),
            np.stack([np.bincount(row, self.color[:, i]) for i in range(3)], axis=1),
            np.bincount(row, self.pixels).astype(np.int64),
            self.best_weight[best],
            self.best_keyframe[best],
            self.best_footprint[best],
        )


class AnchoredCells:
    """Collects keyframes; ``gaussians`` turns what was collected into anchored Gaussians.

    Memory: 100 bytes a cell, plus at most two million unmerged rows; a Gaussian takes 63 bytes (positions, scales and
    anchor 12 each, rotation 16, opacity and keyframe 4 each, colour 3).
    """

    def __init__(self, options: Options, cell_size: float):
        self.options = options
        self.cell_size = cell_size
        self._T_world_keyframe: list[NDArray[np.float64]] = []
        self._cells: _Cells | None = None
        self._pending: list[_Cells] = []

    def add(self, frame: Frame, T_world_cam: NDArray[np.float64]) -> None:
        """Take the next keyframe; its row is the number of keyframes taken before."""
        row = len(self._T_world_keyframe)
        self._T_world_keyframe.append(T_world_cam)
        cells = self._measure(frame, T_world_cam, row)
        if cells is not None:
            self._pending.append(cells)
        if sum(len(cells.key) for cells in self._pending) > _ROWS_BEFORE_MERGE:
            self._merge()

    def gaussians(self, keyframes: Iterable[Frame]) -> Gaussians:
        """One Gaussian per cell with enough measurements. keyframes: those that were taken, in the same order; their
        depth is read again to denoise the surface."""
        self._merge()
        if self._cells is None:
            return _no_gaussians()
        # A cell smaller than the measurements' spacing cannot hold as many as a large one: one is enough there.
        possible = np.maximum((self.cell_size / self._cells.best_footprint) ** 2, 1.0)
        cells = self._cells[self._cells.pixels >= np.minimum(self.options.min_pixels, np.floor(possible))]
        T_world_keyframe = np.stack(self._T_world_keyframe)
        if self.options.denoise:
            cells = self._denoised(cells, keyframes, T_world_keyframe)
        color = np.rint(cells.color / cells.weight[:, None]).astype(np.uint8)
        anchor_cam = _move_each(invert(T_world_keyframe), cells.best_keyframe, cells.points.astype(np.float32))
        spacing = np.maximum(self.cell_size, cells.best_footprint)
        spacing = np.hypot(spacing, self.options.uncertainty / np.sqrt(cells.weight)).astype(np.float32)
        made = ray_aligned(
            anchor_cam, cells.best_keyframe, T_world_keyframe, self.options.coverage * spacing, color, self.options
        )
        return isotropic(made) if self.options.initialisation == "isotropic" else made

    def _denoised(self, cells: _Cells, keyframes: Iterable[Frame], T_world_keyframe: NDArray[np.float64]) -> _Cells:
        """The cells' points where all depth images have the surface, averaged by the cells that they are in now."""
        usable = (
            (frame, np.where(away_from_edges(frame.depth_m, self.options.edge), frame.depth_m, np.float32(0)))
            for frame in keyframes
        )
        found = fusion.denoised(cells.points, usable, T_world_keyframe)
        seen = found.weights > 0  # what no image shows, because its pixel is another point's, stays as it was measured
        weight = np.where(seen, found.weights, cells.weight)
        return _Cells(
            cell_keys(found.points, self.cell_size),
            weight,
            weight[:, None] * found.points,
            (weight / cells.weight)[:, None] * cells.color,
            cells.pixels,
            np.where(seen, found.best, cells.best_weight),
            np.where(seen, found.keyframe, cells.best_keyframe),
            cells.best_footprint,
        )[found.kept].merged()

    def _measure(self, frame: Frame, T_world_cam: NDArray[np.float64], row: int) -> _Cells | None:
        step = self.options.pixel_stride or self._stride(frame)
        usable = away_from_edges(frame.depth_m, self.options.edge)[::step, ::step]
        v, u = (step * index for index in np.nonzero(usable))
        if len(v) == 0:
            return None
        depth = frame.depth_m[v, u]
        pixels = np.stack((u, v), axis=1).astype(np.float32)
        points = transform(T_world_cam, back_project(pixels, depth, frame.intrinsics).astype(np.float64))
        key, cell = np.unique(cell_keys(points, self.cell_size), return_inverse=True)
        weight = 1.0 / depth_sigma(depth).astype(np.float64) ** 2
        total = np.bincount(cell, weight)
        count = np.bincount(cell)
        footprint = np.bincount(cell, step * depth / frame.intrinsics.fx) / count
        colors = frame.color[v, u]
        return _Cells(
            key,
            total,
            np.stack([np.bincount(cell, weight * points[:, i]) for i in range(3)], axis=1),
            np.stack([np.bincount(cell, weight * colors[:, i]) for i in range(3)], axis=1),
            count.astype(np.int64),
            total / count,
            np.full(len(key), row, np.int32),
            footprint.astype(np.float32),
        )

    def _stride(self, frame: Frame) -> int:
        """As many pixels as leave 320 columns, or more where cells are small: about two to a cell's edge."""
        measured = frame.depth_m[frame.depth_m > 0]
        usual = float(np.median(measured)) if len(measured) else 1.0
        fine = int(0.5 * self.cell_size * frame.intrinsics.fx / usual)
        return max(1, min(frame.intrinsics.width // 320, fine))

    def _merge(self) -> None:
        if not self._pending:
            return
        cells, *others = self._pending if self._cells is None else [self._cells, *self._pending]
        self._cells = _Cells(
            *(np.concatenate([getattr(c, f.name) for c in (cells, *others)]) for f in fields(_Cells))
        ).merged()
        self._pending = []


def cell_keys(points_world: NDArray[np.float64], cell_size: float) -> NDArray[np.int64]:
    """(N, 3) metres to (N,) one integer per cell; cells within 2**20 of the origin along each axis are told apart."""
    index = np.floor(points_world / cell_size).astype(np.int64) + _CELLS_PER_AXIS
    return (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]


def ray_aligned(
    anchor_cam: NDArray[np.float32],
    anchor_keyframe: NDArray[np.int32],
    T_world_keyframe: NDArray[np.float64],
    s_perp: NDArray[np.float32],
    colors: NDArray[np.uint8],
    options: Options,
) -> Gaussians:
    """Gaussians at (N, 3) anchors in their keyframes' camera frames, local +z along the viewing ray and
    s = (s_perp, s_perp, gamma s_perp): the paper's geometry-aware initialisation."""
    ray = anchor_cam / np.linalg.norm(anchor_cam, axis=1, keepdims=True)
    # The shortest rotation that takes +z to the ray; rays point forward, so 1 + ray_z > 0.
    quats_cam = np.stack((1 + ray[:, 2], -ray[:, 1], ray[:, 0], np.zeros(len(ray))), axis=1)
    quats_cam /= np.linalg.norm(quats_cam, axis=1, keepdims=True)
    quats_keyframe = rotations_to_quats(T_world_keyframe[:, :3, :3])
    n = len(anchor_cam)
    return Gaussians(
        means=_move_each(T_world_keyframe, anchor_keyframe, anchor_cam),
        scales=np.stack((s_perp, s_perp, options.gamma * s_perp), axis=1).astype(np.float32),
        quats_wxyz=multiply_quats(quats_keyframe[anchor_keyframe], quats_cam).astype(np.float32),
        opacities=np.full(n, options.opacity, np.float32),
        colors=colors,
        anchor_keyframe=anchor_keyframe,
        anchor_cam=anchor_cam,
    )


def isotropic(gaussians: Gaussians) -> Gaussians:
    """The Gaussians as spheres whose standard deviation is the mean distance to the three nearest others.

    Source: B. Kerbl et al., 3D Gaussian Splatting, SIGGRAPH 2023, Sec. 5.1.
    """
    others = min(3, len(gaussians) - 1)
    if others < 1:
        return gaussians
    distances = cKDTree(gaussians.means).query(gaussians.means, k=others + 1, workers=-1)[0][:, 1:]
    radius = np.maximum(distances.mean(axis=1), 1e-4).astype(np.float32)
    quats = np.tile(np.array((1, 0, 0, 0), np.float32), (len(gaussians), 1))
    return replace(gaussians, scales=np.repeat(radius[:, None], 3, axis=1), quats_wxyz=quats)


def anchored_where_they_are(gaussians: Gaussians, T_world_keyframe: NDArray[np.float64]) -> Gaussians:
    """The Gaussians with anchors that say where their means are now, for means that something else has moved."""
    anchor_cam = _move_each(invert(T_world_keyframe), gaussians.anchor_keyframe, gaussians.means)
    return replace(gaussians, anchor_cam=anchor_cam)


def reanchored(
    gaussians: Gaussians, T_world_keyframe_old: NDArray[np.float64], T_world_keyframe_new: NDArray[np.float64]
) -> Gaussians:
    """Means and rotations recomputed after the keyframes moved from the (K, 4, 4) old to the new poses."""
    turn = rotations_to_quats(T_world_keyframe_new[:, :3, :3] @ np.swapaxes(T_world_keyframe_old[:, :3, :3], -1, -2))
    keyframe = gaussians.anchor_keyframe
    return Gaussians(
        means=_move_each(T_world_keyframe_new, keyframe, gaussians.anchor_cam),
        scales=gaussians.scales,
        quats_wxyz=multiply_quats(turn[keyframe], gaussians.quats_wxyz).astype(np.float32),
        opacities=gaussians.opacities,
        colors=gaussians.colors,
        anchor_keyframe=keyframe,
        anchor_cam=gaussians.anchor_cam,
    )


def aligned(gaussians: Gaussians, scale: float, R: NDArray[np.float64], t: NDArray[np.float64]) -> Gaussians:
    """The Gaussians in another world frame: x' = s R x + t, sigma' = s sigma, R_g' = R R_g (paper, "Coordinate System
    Alignment"). Anchors scale with the camera frames that they live in."""
    means = scale * gaussians.means.astype(np.float64) @ R.T + t
    return Gaussians(
        means=means.astype(np.float32),
        scales=(scale * gaussians.scales).astype(np.float32),
        quats_wxyz=multiply_quats(rotations_to_quats(R)[None], gaussians.quats_wxyz).astype(np.float32),
        opacities=gaussians.opacities,
        colors=gaussians.colors,
        anchor_keyframe=gaussians.anchor_keyframe,
        anchor_cam=(scale * gaussians.anchor_cam).astype(np.float32),
    )


def anchor_pixels(gaussians: Gaussians, intrinsics: Intrinsics) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(N, 2) pixels and (N,) depths in metres of the anchors in their keyframes, which share ``intrinsics``."""
    x, y, z = gaussians.anchor_cam.T
    return np.stack((intrinsics.fx * x / z + intrinsics.cx, intrinsics.fy * y / z + intrinsics.cy), axis=1), z


def _move_each(T: NDArray[np.float64], row: NDArray[np.int32], points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Points (N, 3), each by its own transform T[row]."""
    moved = np.einsum("nij,nj->ni", T[row, :3, :3], points.astype(np.float64)) + T[row, :3, 3]
    return moved.astype(np.float32)


def _no_gaussians() -> Gaussians:
    empty = np.zeros((0, 3), np.float32)
    return Gaussians(
        empty, empty, np.zeros((0, 4), np.float32), np.zeros(0, np.float32), np.zeros((0, 3), np.uint8),
        np.zeros(0, np.int32), empty,
    )  # fmt: skip
