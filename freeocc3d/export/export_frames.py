"""The frames that exports may be in, and a map's voxels brought to one of them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import ConfigError, ExportError
from ..core.transforms import invert
from ..core.types import BLOCK, OCCUPIED, UNKNOWN, Occupancy
from ..query.scan_map import Map
from ..settings.option_types import Finite, converted
from ..settings.typed_options import TypedOptions

Frame = Literal["map", "gravity", "first-camera"]
"""The map's frame; z up with the floor at z = 0 and the walls along x and y; z up with the first camera at the origin,
looking along x."""
UprightFrame = Literal["gravity", "first-camera"]
"""Those in which z points up."""
Box = tuple[Finite, Finite, Finite, Finite, Finite, Finite]


class BoxOptions(TypedOptions, frozen=True):
    """The part of a map that is written."""

    box: Box | None = None
    """Lower and upper corner of a box in the frame, x0, y0, z0, x1, y1, z1 in meters: only voxels whose centers lie in
    it are written; null = all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.box is not None and not np.less(self.box[:3], self.box[3:]).all():
            raise ConfigError(
                "'box' has a lower and an upper corner, x0, y0, z0, x1, y1, z1 in meters, each of the first three less "
                f"than its counterpart; got {', '.join(f'{value:g}' for value in self.box)}."
            )


class VoxelOptions(BoxOptions, frozen=True):
    """The frame of the voxels that are written, and which of them are."""

    frame: Frame = "gravity"
    """"gravity" (z up, floor at 0), "first-camera" (z up, origin there) or "map". Voxels keep their places only in the
    map's frame; for the others they are resampled."""


@dataclass(frozen=True)
class PlacedVoxels:
    """Voxels in a frame.

    occupancy: in coordinates of the frame, without features where it is not the map's own.  rows: (V,) row of the map's
    occupied voxel that each occupied one stands for.  T_frame_map: (4, 4).  metric: whether lengths are meters.
    """

    occupancy: Occupancy
    rows: NDArray[np.int64]
    frame: str
    T_frame_map: NDArray[np.float64]
    metric: bool

    @property
    def unit(self) -> str:
        """What lengths are in."""
        return "meters" if self.metric else "units of unknown length"

    def described(self) -> dict[str, Any]:
        """What a reader of an export has to know of its frame; of plain values."""
        return {
            "frame": self.frame,
            "T_frame_map": self.T_frame_map.tolist(),
            "voxel_size_m": self.occupancy.finest,
            "metric": self.metric,
            "up": "z" if self.frame != "map" else "see the map's 'up'",
        }


def to_frame(scan_map: Map, frame: str) -> NDArray[np.float64]:
    """(4, 4) ``T_frame_map`` of a frame, by its name. Raises ConfigError for another name."""
    converted(Frame, frame, "frame")
    if frame == "map":
        return np.eye(4)
    if frame == "gravity":
        return scan_map.T_gravity_map
    from ..occupancy.gravity_frame import compute_first_camera_frame

    trajectory = scan_map.trajectory
    posed = np.flatnonzero(trajectory.has_pose)
    if not len(posed):
        raise ExportError("The map has no camera pose, so there is no first camera: use --frame gravity.")
    return compute_first_camera_frame(scan_map.T_gravity_map, trajectory.T_world_cam[posed[0]])


def place_voxels(
    scan_map: Map,
    frame: str,
    origin: ArrayLike | None = None,
    one_size: bool = False,
    box: Box | None = None,
) -> PlacedVoxels:
    """The map's voxels in a frame. In the map's frame they stay what they are; in another they are resampled on a
    lattice of the map's voxel size (the largest, of a map of several), and so they are where ``one_size`` asks for it
    or where ``origin``, a place of the new lattice, does not lie on the old one.

    origin: (3,) lower corner of some voxel, in the frame; by default such that z = 0 lies amid a layer of voxels, the
    map's lattice in the map's frame.  box: x0, y0, z0, x1, y1, z1 in the frame: what lies outside of it, by voxels'
    centers, is unknown. Raises ExportError for a map of which nothing is known, there.
    """
    there = _placed(scan_map, frame, origin, one_size)
    return _within(there, np.array(box).reshape(2, 3)) if box is not None else there


def _placed(scan_map: Map, frame: str, origin: ArrayLike | None, one_size: bool) -> PlacedVoxels:
    from ..occupancy.levels import make_uniform
    from ..occupancy.resampling import resample_occupancy

    occupancy, T = scan_map.occupancy, to_frame(scan_map, frame)
    if not len(occupancy.keys):
        raise ExportError("The map has no voxel to write.")
    own = frame == "map" and _on_lattice(occupancy, origin)
    if own and not (one_size and occupancy.deepest):
        return PlacedVoxels(occupancy, np.arange(len(occupancy.colors)), frame, T, scan_map.metric)
    plain = occupancy.replace(features=np.zeros((len(occupancy.colors), 0), np.float16))
    one = make_uniform(plain) if occupancy.deepest else plain
    if own:
        return PlacedVoxels(one, _nearest(plain, one), frame, T, scan_map.metric)
    at = (0.0, 0.0, -0.5 * one.voxel_size) if origin is None else origin
    new, rows = resample_occupancy(one, T, np.asarray(at, np.float64))
    return PlacedVoxels(new, _nearest(plain, one)[rows] if occupancy.deepest else rows, frame, T, scan_map.metric)


def _within(there: PlacedVoxels, corners: NDArray[np.float64]) -> PlacedVoxels:
    occupancy = there.occupancy
    edge = occupancy.voxel_size / 2.0 ** occupancy.levels[:, None, None]
    centers = occupancy.origin[:, None] + (BLOCK * occupancy.keys[:, :, None] + np.arange(BLOCK) + 0.5) * edge
    x, y, z = ((centers >= corners[0, :, None]) & (centers <= corners[1, :, None])).transpose(1, 0, 2)
    inside = (x[:, :, None, None] & y[:, None, :, None] & z[:, None, None, :]).reshape(-1, BLOCK**3)
    state = np.where(inside, occupancy.state, UNKNOWN).astype(np.uint8)
    blocks = (state != UNKNOWN).any(axis=1)
    if not blocks.any():
        known = centers[(occupancy.state != UNKNOWN).any(axis=1)]
        low, high = known.min(axis=(0, 2)), known.max(axis=(0, 2))
        spans = ", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", low, high, strict=True))
        raise ExportError(f"Nothing of the map lies in the box: in the {there.frame} frame it reaches from {spans} m.")
    kept = inside[occupancy.state == OCCUPIED]
    part = occupancy.replace(
        features=occupancy.features[kept],
        colors=occupancy.colors[kept],
        levels=occupancy.levels[blocks],
        state=state[blocks],
        **{name: getattr(occupancy, name)[blocks] for name in ("keys", "probability", "free", "hits")},
    )
    return PlacedVoxels(part, there.rows[kept], there.frame, there.T_frame_map, there.metric)


def find_floor_z(scan_map: Map, T_frame_map: NDArray[np.float64]) -> float:
    """Height of the floor in a frame whose z points up, meters."""
    return float((T_frame_map @ invert(scan_map.T_gravity_map))[2, 3])


def write_description(path: Path, described: dict[str, Any]) -> None:
    """Write ``PATH.json`` next to an export whose format cannot say its frame. Raises OSError."""
    unit = "metre" if described.get("metric", True) else "unknown"
    text = json.dumps({"file": path.name, "unit": unit, **described}, indent=1)
    path.with_name(f"{path.name}.json").write_text(text + "\n", encoding="utf-8")


def find_world(scan_map: Map, T_frame_map: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) from the frame to the world that the map's ``T_world_map`` leads to."""
    return np.asarray(np.array(scan_map.manifest.T_world_map, np.float64) @ invert(T_frame_map))


def _on_lattice(occupancy: Occupancy, origin: ArrayLike | None) -> bool:
    if origin is None:
        return True
    off = (occupancy.origin - np.asarray(origin)) / occupancy.finest
    return bool(np.abs(off - np.rint(off)).max() < 1e-3)


def _nearest(occupancy: Occupancy, one: Occupancy) -> NDArray[np.int64]:
    """(V,) row of the occupied voxel nearest to each of a map made of the same voxels."""
    from scipy.spatial import KDTree

    if not len(one.colors):
        return np.zeros(0, np.int64)
    tree = KDTree(occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges()))
    return np.asarray(tree.query(one.centers(one.occupied_voxels()))[1], np.int64)
