"""A map with several voxel sizes: coarse where the surface is flat and of one kind, fine elsewhere.

A block of 8 x 8 x 8 voxels is split into eight blocks of half its voxel size where one voxel would hide something:
where the surface leaves its plane by a tenth of a voxel and by more than the depth noise, or where the meanings of
neighboring Gaussians differ. Voxels never become smaller than the depth noise. The content of the split blocks is
lifted again from the keyframes, in cells of half the size, and tested again, until the smallest size is reached. Every
block is projected from the Gaussians of its own size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core.compiling import njit
from ..core.depth_sensors import STRUCTURED_LIGHT, DepthSensor, find_sensor
from ..core.errors import MapError
from ..core.hash_table import build_table, find_row, packed_key
from ..core.progress import Progress
from ..core.types import BLOCK, OCCUPIED, Gaussians, Occupancy, PosedFrame
from ..core.voxel_keys import pack_voxels, unpack_voxels
from ..gaussians.surface_cells import cell_keys
from ..language.feature_codec import Codec
from ..occupancy import build, carve, levels, splat
from ..occupancy.confirmed_depth import hide_unconfirmed
from ..query.objects.keeping import find_kept_objects
from ..query.scan_map import Map, load_map
from ..settings.config import Settings
from ..storage.manifest import Refined
from ..storage.work_folder import WorkFolder
from ..storage.writer import MapParts, write_changed_map
from .box_refinement import SMALLEST_VOXEL_M, lift_features_again, lift_gaussians, read_settings

_CUBE = 2
"""Edge in voxels of the cubes in which the surface is compared with a plane: a flat surface has 4 x 4 Gaussians in
one."""
_FEWEST = 5  # Gaussians that a cube needs to be compared with a plane
_UNEVEN = 0.1
"""Root-mean-square distance to the plane, in voxels, above which a surface is not flat: a step of a quarter of a voxel,
a corner of a room, or a ball with a radius of five voxels."""
_NEIGHBORS, _ALIKE = 6, 0.8
"""Number of nearest Gaussians whose features are compared, and the cosine below which two meanings differ."""
_ROWS = 16384


def count_halvings(voxel_size: float, finest: float) -> int:
    """The number of halvings from ``voxel_size`` to ``finest``, meters. Raises MapError if halving does not reach
    it."""
    count = round(math.log2(voxel_size / finest)) if 0 < finest <= voxel_size else -1
    if count < 0 or finest < SMALLEST_VOXEL_M or abs(voxel_size / 2**count / finest - 1) > 1e-6:
        sizes = [voxel_size / 2**n for n in range(1, 9) if voxel_size / 2**n >= SMALLEST_VOXEL_M]
        offered = ", ".join(f"{size:g}" for size in sizes) or "none"
        raise MapError(
            f"Halving voxels of {voxel_size:g} m never gives {finest:g} m; possible smallest sizes (m): {offered}."
        )
    return count


def build_adaptive(
    base: Occupancy,
    gaussians: Gaussians,
    features: NDArray[np.float16],
    posed: Callable[[], Iterator[PosedFrame]],
    T_world_keyframe: NDArray[np.float64],
    encode: Callable[[Gaussians], NDArray[np.float16]],
    settings: Settings,
    finest: float,
    progress: Progress,
) -> Occupancy:
    """The map ``base``, which has one voxel size, with voxels down to ``finest`` meters where they show more.

    gaussians, features: the N Gaussians of the map, and their (N, D) features.  posed: yields the keyframes at each
    call.  T_world_keyframe: (K, 4, 4).  encode: computes layer 3 of further Gaussians.  settings: the map's
    configuration. Raises MapError for a size that halving does not reach.
    """
    count = count_halvings(base.voxel_size, finest)
    changing = _changing(gaussians.means, features)
    tree = cKDTree(gaussians.means) if len(gaussians) else None
    occupied = np.sort(pack_voxels(base.keys[(base.state == OCCUPIED).any(axis=1)]))
    sensor = find_sensor(settings.capture.sensor)
    split = _detailed(occupied, gaussians, changing, base.origin, base.voxel_size, sensor) if count else occupied[:0]
    whole = ~np.isin(pack_voxels(base.keys), split)
    found: list[Gaussians] = []
    leaves: list[NDArray[np.int64]] = []
    for level in range(1, count + 1):
        if not len(split):
            break
        size = base.voxel_size / 2**level
        region = Blocks(split, base.origin, 2 * BLOCK * size)
        made = lift_gaussians(posed, region, size, settings, T_world_keyframe, base.origin, progress)
        parts = np.sort(pack_voxels(levels.subdivide_keys(unpack_voxels(split))))
        split = parts[:0]
        if level < count and tree is not None and len(made):
            nearest = np.asarray(tree.query(made.means, workers=-1)[1])
            split = _detailed(parts, made, changing[nearest], base.origin, size, sensor)
        found.append(made)
        leaves.append(np.setdiff1d(parts, split, assume_unique=True))
    if not found:
        return base
    all_features = encode(Gaussians.concatenated(found))
    ends = np.cumsum([0, *(len(made) for made in found)])
    carving = settings.carving
    sizes = [base.voxel_size / 2**level for level in range(1, len(found) + 1)]
    seen = [carve.DepthEvidence(base.origin, size, carving, own) for size, own in zip(sizes, leaves, strict=True)]
    progress.stage("occupancy", len(T_world_keyframe))
    confirmed = hide_unconfirmed(posed(), gaussians, base.voxel_size, settings.gaussians.cell_size)
    for done, look in enumerate(confirmed, 1):
        for evidence in seen:
            evidence.add(look.frame, look.T_world_cam)
        progress.advance(done)
    levelled = [levels.select_blocks(base, whole)]
    for n, (size, own, evidence) in enumerate(zip(sizes, leaves, seen, strict=True)):
        splatting = settings.occupancy.changed(voxel_size=size)
        bins = splat.bin_gaussians(found[n], base.origin, splatting).only(own)
        mine = all_features[ends[n] : ends[n + 1]]
        part = build.build_blocks(own, bins, found[n], mine, evidence, splatting, carving)
        levelled.append(levels.select_blocks(part, levels.mask_known_blocks(part)))
    return levels.combine_levels(levelled)


def refine_where_needed(
    scan_map: Map, finest: float, output: str | Path, *, overwrite: bool = False, progress: Progress | None = None
) -> Map:
    """Write a map to the folder ``output``, with voxels down to ``finest`` meters where they show more. Raises
    FreeOccError for a size that halving does not reach, a map that has several sizes already, or an existing folder."""
    progress = progress or Progress()
    base = scan_map.occupancy
    if base.deepest:
        raise MapError(f"{scan_map.path} already has voxels of several sizes: refine the map that it was made from.")
    if not count_halvings(base.voxel_size, finest):
        raise MapError(f"{scan_map.path} already has voxels of {finest:g} m: give a smaller size.")
    with WorkFolder.made_of(scan_map.path, Path(output), overwrite) as work:
        settings, trajectory = read_settings(scan_map).changed("occupancy", finest=finest), scan_map.trajectory

        def posed() -> Iterator[PosedFrame]:
            for row, (frame, T) in enumerate(zip(scan_map.keyframes, trajectory.T_world_keyframe, strict=True)):
                yield PosedFrame(frame, T, row)

        def encode(gaussians: Gaussians) -> NDArray[np.float16]:
            return lift_features_again(
                scan_map, scan_map.keyframes, trajectory.T_world_keyframe, gaussians, settings, progress
            )

        occupancy = build_adaptive(
            base, scan_map.gaussians, scan_map.gaussian_features, posed, trajectory.T_world_keyframe, encode, settings,
            finest, progress,
        )  # fmt: skip
        progress.stage("saving")
        refined = Refined(map=str(scan_map.path.absolute()))
        parts = MapParts(
            msgspec.structs.replace(scan_map.manifest, refined=refined),
            settings,
            lambda: scan_map.report,
            occupancy,
            Codec.fit(np.asarray(occupancy.features)),
            scan_map.gaussian_features,
            find_objects=find_kept_objects,
        )
        write_changed_map(scan_map, work, Path(output), parts)
    return load_map(output)


def _detailed(
    blocks: NDArray[np.int64],
    gaussians: Gaussians,
    changing: NDArray[np.bool_],
    origin: NDArray[np.float64],
    voxel_size: float,
    sensor: DepthSensor = STRUCTURED_LIGHT,
) -> NDArray[np.int64]:
    """The blocks, ascending packed keys, in which the surface is not flat or has several meanings.

    gaussians: N of the blocks' size.  changing: (N,) whether the meaning changes at each.
    """
    edge = _CUBE * voxel_size
    points = gaussians.means.astype(np.float64) - origin
    _, first, cube = np.unique(cell_keys(points, edge), return_index=True, return_inverse=True)
    index = np.floor(points / edge)
    local = points - (index + 0.5) * edge
    n = np.bincount(cube)
    mean = np.stack([np.bincount(cube, local[:, i]) / n for i in range(3)], axis=1)
    moments = np.empty((len(n), 3, 3))
    for i in range(3):
        for j in range(3):
            moments[:, i, j] = np.bincount(cube, local[:, i] * local[:, j]) / n - mean[:, i] * mean[:, j]
    off_plane = np.sqrt(np.maximum(np.linalg.eigvalsh(moments)[:, 0], 0.0))
    noise = np.bincount(cube, sensor.compute_sigma(np.abs(gaussians.anchor_cam[:, 2]))) / n
    uneven = (n >= _FEWEST) & (off_plane > np.hypot(_UNEVEN * voxel_size, noise))
    uneven |= np.bincount(cube, changing) > 0
    uneven &= noise <= 0.5 * voxel_size  # smaller voxels would show the noise
    of_block = pack_voxels(index[first[uneven]].astype(np.int64) // (BLOCK // _CUBE))
    return np.intersect1d(blocks, of_block)


def _changing(means: NDArray[np.float32], features: NDArray[np.float16]) -> NDArray[np.bool_]:
    """(N,) whether one of the nearest Gaussians has another meaning. Gaussians without features have none."""
    changing = np.zeros(len(means), bool)
    count = min(_NEIGHBORS, len(means) - 1)
    if count < 1 or not features.shape[1]:
        return changing
    nearest = cKDTree(means).query(means, k=count + 1, workers=-1)[1][:, 1:]
    known: NDArray[np.bool_] = np.asarray(features.any(axis=1))
    for start in range(0, len(means), _ROWS):
        rows = slice(start, start + _ROWS)
        own = features[rows].astype(np.float32)
        for column in nearest[rows].T:
            cosine = np.einsum("nd,nd->n", own, features[column].astype(np.float32))
            changing[rows] |= (cosine < _ALIKE) & known[rows] & known[column]
    return changing


class Blocks:
    """A set of cubes of one lattice, given by packed keys: a part of space, as ``box_refinement.Box`` is.

    edge: of a cube, meters.
    """

    def __init__(self, packed: NDArray[np.int64], origin: NDArray[np.float64], edge: float):
        self.origin, self.edge = origin, edge
        self._table, self._rows = build_table(packed, len(packed))

    def contains(self, points: NDArray[np.floating], margin: float) -> NDArray[np.bool_]:
        """(P,) whether each of (P, 3) points is inside, or no farther outside than the margin along any axis. The
        margin must not exceed half an edge."""
        local = (np.asarray(points, np.float64) - self.origin) / self.edge
        return np.asarray(_inside(local, margin / self.edge, self._table, self._rows))


@njit(parallel=True, cache=True)
def _inside(
    points: NDArray[np.float64], margin: float, table: NDArray[np.int64], rows: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """``Blocks.contains`` in units of edges."""
    inside = np.zeros(len(points), np.bool_)
    for p in prange(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for i in range(math.floor(x - margin), math.floor(x + margin) + 1):
            for j in range(math.floor(y - margin), math.floor(y + margin) + 1):
                for k in range(math.floor(z - margin), math.floor(z + margin) + 1):
                    if find_row(table, rows, packed_key(i, j, k)) >= 0:
                        inside[p] = True
    return inside
