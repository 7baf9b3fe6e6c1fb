"""Lifts keyframe depth to Gaussians: one per cell of the surface, ray-aligned, anchored to a keyframe.

Dense pixels are not Gaussians of their own: a wall seen by a hundred keyframes would be a hundred layers thick, which
saturates the occupancy product and fills memory. The measurements of a cell are averaged, weighted by their depth
uncertainty; the averages are moved to where all depth images together have the surface (``fusion``) and averaged by
cells again; and what results is anchored to the keyframe that measures it best. The number of Gaussians grows with the
surface, not with the frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core.transforms import invert, multiply_quats, rotations_to_quats
from ..core.types import Frame, Gaussians, PosedFrame
from ..settings.stages import GaussianOptions as Options
from . import denoising
from .surface_cells import Cells, CellSums


def compute_least_scale(options: Options, cell_size: float, voxel_size: float) -> float:
    """Standard deviation in metres that Gaussians of cells of ``cell_size`` must at least have to be shown by voxels of
    ``voxel_size``: that of cells of half a voxel, if theirs are smaller; 0 where they are not."""
    usual = 0.5 * voxel_size
    return options.coverage * usual if cell_size < usual else 0.0


class AnchoredCells:
    """Collects keyframes; ``gaussians`` turns what was collected into anchored Gaussians.

    Memory: 130 bytes a cell; a Gaussian takes 67 bytes (positions, scales and anchor 12 each, rotation 16, opacity and
    keyframe 4 each, colour 3, feature 4).
    """

    def __init__(self, options: Options, cell_size: float, T_world_keyframe: NDArray[np.float64]):
        self.options = options
        self.cell_size = cell_size
        self._T_world_keyframe = T_world_keyframe
        self._sums = CellSums(cell_size)

    def add(self, posed: PosedFrame) -> None:
        """Take a keyframe, or a frame between keyframes: what it shows is anchored to the keyframe that it hangs on."""
        self._sums.add_frame(posed, self.stride(posed.frame), self.options.edge)

    def gaussians(self, frames: Iterable[PosedFrame]) -> Gaussians:
        """One Gaussian per cell with enough measurements. frames: those that were taken, again, to denoise the
        surface."""
        cells = self._sums.cells()
        # A cell smaller than the measurements' spacing cannot hold as many as a large one: one is enough there.
        possible = np.maximum((self.cell_size / cells.footprint) ** 2, 1.0)
        cells = cells[cells.pixels >= np.minimum(self.options.min_pixels, np.floor(possible))]
        if self.options.denoise:
            cells = self._denoised(cells, frames)
        T_world_keyframe = self._T_world_keyframe
        anchor_cam = _move_each(invert(T_world_keyframe), cells.keyframe, cells.points.astype(np.float32))
        spacing = np.hypot(
            np.maximum(self.cell_size, cells.footprint), self.options.uncertainty / np.sqrt(cells.weights)
        )
        colors = np.rint(cells.colors).astype(np.uint8)
        s_perp = (self.options.coverage * spacing).astype(np.float32)
        made = align_to_rays(anchor_cam, cells.keyframe, T_world_keyframe, s_perp, colors, self.options)
        return make_isotropic(made) if self.options.initialization == "isotropic" else made

    def _denoised(self, cells: Cells, frames: Iterable[PosedFrame]) -> Cells:
        """The cells' points where all depth images have the surface, averaged by the cells that they are in now."""
        directions = cells.points - self._T_world_keyframe[cells.keyframe, :3, 3]
        found = denoising.denoise(cells.points, directions, frames, self.options.edge)
        seen = found.weights > 0  # what no image shows, because its pixel is another point's, stays as it was measured
        moved = replace(
            cells,
            points=found.points,
            weights=np.where(seen, found.weights, cells.weights),
            best=np.where(seen, found.best, cells.best),
            keyframe=np.where(seen, found.keyframe, cells.keyframe),
        )
        sums = CellSums(self.cell_size)
        sums.add(moved[found.kept])
        return sums.cells()

    def stride(self, frame: Frame) -> int:
        """Every how many-th pixel of a frame is taken: the option, or as many as leave 320 columns, more where cells
        are small: about two to a cell's edge. All are where depth says itself how uncertain it is."""
        if self.options.pixel_stride is not None:
            return self.options.pixel_stride
        if frame.depth_sigma_m is not None:
            return 1
        measured = frame.depth_m[::4, ::4]
        measured = measured[measured > 0]
        usual = float(np.median(measured)) if len(measured) else 1.0
        fine = int(0.5 * self.cell_size * frame.intrinsics.fx / usual)
        return max(1, min(frame.intrinsics.width // 320, fine))


def align_to_rays(
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
    # The shortest rotation that takes +z to the ray. What a frame beside the keyframe shows may lie behind it, but for
    # exactly backwards there is one; there, none does, for an ellipsoid has no sign.
    quats_cam = np.stack((np.maximum(1 + ray[:, 2], 1e-6), -ray[:, 1], ray[:, 0], np.zeros(len(ray))), axis=1)
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


def make_isotropic(gaussians: Gaussians) -> Gaussians:
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


def anchor_in_place(gaussians: Gaussians, T_world_keyframe: NDArray[np.float64]) -> Gaussians:
    """The Gaussians with anchors that say where their means are now, for means that something else has moved."""
    anchor_cam = _move_each(invert(T_world_keyframe), gaussians.anchor_keyframe, gaussians.means)
    return replace(gaussians, anchor_cam=anchor_cam)


def reanchor(
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


def align_gaussians(gaussians: Gaussians, scale: float, R: NDArray[np.float64], t: NDArray[np.float64]) -> Gaussians:
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


def _move_each(T: NDArray[np.float64], row: NDArray[np.int32], points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Points (N, 3), each by its own transform T[row]."""
    moved = np.einsum("nij,nj->ni", T[row, :3, :3], points.astype(np.float64)) + T[row, :3, 3]
    return moved.astype(np.float32)
