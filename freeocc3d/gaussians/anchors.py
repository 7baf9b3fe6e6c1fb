"""Lifts keyframe depth to Gaussians: one per surface cell, a thin disc on the surface, anchored to a keyframe.

Dense pixels do not become Gaussians of their own: a wall seen by a hundred keyframes would be a hundred layers thick,
which saturates the occupancy product and fills memory. Instead, the measurements in a cell are averaged, weighted by
their depth uncertainty. The averages move to the surface that all depth maps together show (``denoising``) and are
averaged by cell again, and to the planes of their neighbors as far as they are less certain (``local_planes``). What a
mirror shows is left out (``reflections``). Each result is anchored to the keyframe that measures it best. The number of
Gaussians grows with the surface, not with the number of frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core.errors import ConfigError
from ..core.transforms import invert, multiply_quats, rotations_to_quats
from ..core.types import Frame, Gaussians, PosedFrame
from ..settings.stages import GaussianOptions as Options
from . import denoising
from .local_planes import fit_planes
from .reflections import find_reflections
from .surface_cells import Cells, CellSums

_COLUMNS = 320
"""Smallest number of columns to take from a depth image; all if it has fewer. More pixels per cell add little."""

_SAMPLE = 32
"""Frames, at most, from which the registration error is estimated; a half of them at least if there are so many. A
kitchen's error of 13.5 mm comes out as 10 to 12."""
_NO_COLOR = np.zeros((0, 0, 3), np.uint8)  # no part of the frame's colors, which would stay in memory
_SAMPLED = 4  # step between the pixels for a frame's median depth
_BACKWARD = 1e-6  # smallest 1 + z of a ray, so that a ray exactly backward gives a quaternion
_FINEST = 12.0
"""Cells that a pixel covers along an edge, at most."""
_LEAST_RADIUS_M = 1e-4  # of Gaussians whose neighbors are at the same place


def compute_least_scale(options: Options, cell_size: float, voxel_size: float) -> float:
    """The smallest standard deviation, in meters, that lets voxels of ``voxel_size`` show Gaussians of cells of
    ``cell_size``: that of cells of half a voxel if their own cells are smaller, otherwise 0."""
    usual = 0.5 * voxel_size
    return options.coverage * usual if cell_size < usual else 0.0


class AnchoredCells:
    """Collects keyframes; ``gaussians`` turns them into anchored Gaussians.

    Memory: 130 bytes per cell. A Gaussian takes 67 bytes (positions, scales and anchor 12 each, rotation 16, opacity
    and keyframe 4 each, color 3, feature 4).
    """

    def __init__(
        self,
        options: Options,
        cell_size: float,
        T_world_keyframe: NDArray[np.float64],
        voxel_origin: NDArray[np.float64] | None = None,
    ):
        """voxel_origin: (3,) a corner of voxels. Cells begin there along x and y, and at z = 0: the floor, and walls in
        the middle of voxels, lie between two layers of cells of half a voxel, which measures best: as plane surfaces
        fill fewest cells where they lie within a layer. None = cells begin at the world's origin."""
        self.options = options
        self.cell_size = cell_size
        self._origin = None if voxel_origin is None else np.array((*voxel_origin[:2], 0.0))
        self._T_world_keyframe = T_world_keyframe
        self._sums = CellSums(cell_size, self._origin)
        self._compared = False
        self._reach_m = 0.0  # the greatest depth of the added frames
        self._sample: list[PosedFrame] = []  # every n-th of the added frames, without colors
        self._added, self._every = 0, 1

    def add(self, posed: PosedFrame) -> None:
        """Adds a keyframe, or a frame between keyframes; the points of such a frame are anchored to its keyframe."""
        if not self._compared:
            self._compared = _refuse_tiny(self.cell_size, posed.frame)
        self._reach_m = max(self._reach_m, float(posed.frame.depth_m.max(initial=0.0)))
        stride = choose_stride(posed.frame, self.options, self.cell_size)
        self._sums.add_frame(posed, stride, self.options.edge)
        if self._added % self._every == 0:
            self._sample.append(posed._replace(frame=replace(posed.frame, color=_NO_COLOR)))
        self._added += 1
        if len(self._sample) > _SAMPLE:
            self._sample, self._every = self._sample[::2], 2 * self._every

    def gaussians(self, frames: Iterable[PosedFrame]) -> Gaussians:
        """Returns one Gaussian per cell with enough measurements. frames: the added frames again, to denoise the
        surface."""
        cells = self._sums.cells()
        # A cell smaller than the spacing of the measurements cannot contain as many as a large one: one is enough
        # there.
        possible = np.maximum((self.cell_size / cells.footprint) ** 2, 1.0)
        cells = cells[cells.pixels >= np.minimum(self.options.min_pixels, np.floor(possible))]
        if self.options.denoise:
            cells = self._denoised(cells, frames)
        return self._initialized(cells)

    def _initialized(self, cells: Cells) -> Gaussians:
        """The Gaussians of the cells, with the shapes that ``initialization`` names."""
        kind, T_world_keyframe = self.options.initialization, self._T_world_keyframe
        spacing, sigma_m = np.maximum(self.cell_size, cells.footprint), 1.0 / np.sqrt(cells.weights)
        points, planes = cells.points, None
        if kind == "disc":
            cameras = T_world_keyframe[cells.keyframe, :3, 3]
            planes = fit_planes(points, sigma_m, points - cameras, spacing)
            if self.options.denoise:
                real = ~find_reflections(planes.points, planes.normals, cameras, self.cell_size)
                cells, planes, spacing = cells[real], planes[real], spacing[real]
            points = planes.points
        else:
            spacing = np.hypot(spacing, self.options.uncertainty * sigma_m)
        anchor_cam = _move_each(invert(T_world_keyframe), cells.keyframe, points.astype(np.float32))
        colors = np.rint(cells.colors).astype(np.uint8)
        s_perp = (self.options.coverage * spacing).astype(np.float32)
        made = align_to_rays(anchor_cam, cells.keyframe, T_world_keyframe, s_perp, colors, self.options)
        if planes is not None:
            return lay_discs(made, planes.normals, planes.sigma_m)
        return make_isotropic(made) if kind == "isotropic" else made

    def _denoised(self, cells: Cells, frames: Iterable[PosedFrame]) -> Cells:
        """Moves the points of the cells to the surface that all depth maps show, and averages them by their new
        cells."""
        directions = cells.points - self._T_world_keyframe[cells.keyframe, :3, 3]
        found = denoising.denoise(cells.points, directions, frames, self.options.edge, self._reach_m, self._sample)
        seen = found.weights > 0  # points that no image shows, because others cover their pixels, stay where they are
        moved = replace(
            cells,
            points=found.points,
            weights=np.where(seen, found.weights, cells.weights),
            best=np.where(seen, found.best, cells.best),
            keyframe=np.where(seen, found.keyframe, cells.keyframe),
        )
        sums = CellSums(self.cell_size, self._origin)
        sums.add(moved[found.kept])
        return sums.cells()


def choose_stride(frame: Frame, options: Options, cell_size: float) -> int:
    """The step between the pixels used in a frame: the option, or the step that leaves about 320 columns. If cells, of
    ``cell_size`` meters, are small, the step is smaller: about two pixels per cell edge. If the depth states its
    uncertainty, all pixels are used."""
    if options.pixel_stride is not None:
        return options.pixel_stride
    if frame.depth_sigma_m is not None:
        return 1
    measured = frame.depth_m[::_SAMPLED, ::_SAMPLED]
    measured = measured[measured > 0]
    usual = float(np.median(measured)) if len(measured) else 1.0
    fine = int(0.5 * cell_size * frame.intrinsics.fx / usual)
    return max(1, min(frame.intrinsics.width // _COLUMNS, fine))


def _refuse_tiny(cell_size: float, frame: Frame) -> bool:
    """Whether a frame has depth to compare the cells with. Raises ConfigError if they are so much smaller than what a
    pixel covers that voxels of this size cannot show anything but single measurements."""
    measured = frame.depth_m[frame.depth_m > 0]
    if not len(measured):
        return False
    footprint = float(np.median(measured)) / frame.intrinsics.fx
    if cell_size < footprint / _FINEST:
        raise ConfigError(
            f"Gaussians of {cell_size:.2g} m, half a voxel unless gaussians.cell_size is given, are far smaller than "
            f"the {footprint:.2g} m that a pixel covers at the usual depth: choose occupancy.voxel_size or "
            f"gaussians.cell_size of at least {footprint / _FINEST * 2:.2g}."
        )
    return True


def align_to_rays(
    anchor_cam: NDArray[np.float32],
    anchor_keyframe: NDArray[np.int32],
    T_world_keyframe: NDArray[np.float64],
    s_perp: NDArray[np.float32],
    colors: NDArray[np.uint8],
    options: Options,
) -> Gaussians:
    """Makes Gaussians at (N, 3) anchors in the camera frames of their keyframes, with local +z along the viewing ray
    and s = (s_perp, s_perp, gamma s_perp): the paper's geometry-aware initialization."""
    ray = anchor_cam / np.linalg.norm(anchor_cam, axis=1, keepdims=True)
    # The shortest rotation from +z to the ray. A point from a frame near the keyframe may be behind the keyframe; the
    # rotation exists for it, too, except exactly backward. There none is needed: an ellipsoid has no sign.
    quats_cam = np.stack((np.maximum(1 + ray[:, 2], _BACKWARD), -ray[:, 1], ray[:, 0], np.zeros(len(ray))), axis=1)
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


def lay_discs(gaussians: Gaussians, normals: NDArray[np.float64], sigma_m: NDArray[np.float64]) -> Gaussians:
    """Returns the Gaussians as discs: local +z along their (N, 3) unit normals, world, and s = (s_perp, s_perp,
    s_normal), where s_normal is the (N,) standard deviations of their places, meters."""
    normals = np.where(normals[:, 2:] < 0, -normals, normals)  # an ellipsoid has no sign: the shortest rotation from +z
    quats = np.stack((1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))), axis=1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = np.stack((*gaussians.scales[:, :2].T, sigma_m), axis=1)
    return replace(gaussians, quats_wxyz=quats.astype(np.float32), scales=scales.astype(np.float32))


def make_isotropic(gaussians: Gaussians) -> Gaussians:
    """Returns the Gaussians as spheres; the standard deviation is the mean distance to the three nearest neighbors.

    Source: B. Kerbl et al., 3D Gaussian Splatting, SIGGRAPH 2023, Sec. 5.1.
    """
    others = min(3, len(gaussians) - 1)
    if others < 1:
        return gaussians
    distances = cKDTree(gaussians.means).query(gaussians.means, k=others + 1, workers=-1)[0][:, 1:]
    radius = np.maximum(distances.mean(axis=1), _LEAST_RADIUS_M).astype(np.float32)
    quats = np.tile(np.array((1, 0, 0, 0), np.float32), (len(gaussians), 1))
    return replace(gaussians, scales=np.repeat(radius[:, None], 3, axis=1), quats_wxyz=quats)


def anchor_in_place(gaussians: Gaussians, T_world_keyframe: NDArray[np.float64]) -> Gaussians:
    """Returns the Gaussians with anchors at their current means, after other code has moved the means."""
    anchor_cam = _move_each(invert(T_world_keyframe), gaussians.anchor_keyframe, gaussians.means)
    return replace(gaussians, anchor_cam=anchor_cam)


def reanchor(
    gaussians: Gaussians, T_world_keyframe_old: NDArray[np.float64], T_world_keyframe_new: NDArray[np.float64]
) -> Gaussians:
    """Recomputes means and rotations after the keyframes moved from the (K, 4, 4) old poses to the new ones."""
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
    """Returns the Gaussians in another world frame: x' = s R x + t, sigma' = s sigma, R_g' = R R_g (paper, "Coordinate
    System Alignment"). The anchors scale with their camera frames."""
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
    """Transforms (N, 3) points, each by its own T[row]."""
    moved = np.einsum("nij,nj->ni", T[row, :3, :3], points.astype(np.float64)) + T[row, :3, 3]
    return moved.astype(np.float32)
