"""The frames of exports. Brings a map's voxels into one of them."""

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
"""The map's frame; z up with the floor at z = 0 and the walls along x and y; z up with the first camera at the origin
and its view along x."""
UprightFrame = Literal["gravity", "first-camera"]
"""The frames in which z points up."""
Box = tuple[Finite, Finite, Finite, Finite, Finite, Finite]


class BoxOptions(TypedOptions, frozen=True):
    """The part of a map to write."""

    box: Box | None = None
    """Lower and upper corner of a box in the frame, x0, y0, z0, x1, y1, z1 in meters. Only voxels with centers in the
    box are written; null = all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.box is not None and not np.less(self.box[:3], self.box[3:]).all():
            raise ConfigError(
                "'box' takes a lower and an upper corner, x0, y0, z0, x1, y1, z1 in meters, with x0 < x1, y0 < y1 and "
                f"z0 < z1; got {', '.join(f'{value:g}' for value in self.box)}."
            )


class VoxelOptions(BoxOptions, frozen=True):
    """The frame of the written voxels, and the part of the map to write."""

    frame: Frame = "gravity"
    """"gravity" (z up, floor at 0), "first-camera" (z up, first camera at the origin) or "map". Voxels keep their
    places only in the map's frame; the other frames resample them."""


@dataclass(frozen=True)
class PlacedVoxels:
    """Voxels in a frame.

    occupancy: in coordinates of the frame, without features unless it is the map's own.  rows: (V,) for each occupied
    voxel, the row of the map's occupied voxel that it stands for.  T_frame_map: (4, 4).  metric: whether lengths are
    meters.
    """

    occupancy: Occupancy
    rows: NDArray[np.int64]
    frame: str
    T_frame_map: NDArray[np.float64]
    metric: bool

    @property
    def unit(self) -> str:
        """The unit of lengths, in words."""
        return "meters" if self.metric else "units of unknown length"

    def described(self) -> dict[str, Any]:
        """Returns what a reader of an export must know about its frame, as plain values."""
        return {
            "frame": self.frame,
            "T_frame_map": self.T_frame_map.tolist(),
            "voxel_size_m": self.occupancy.finest,
            "metric": self.metric,
            "up": "z" if self.frame != "map" else "see the map's 'up'",
        }


def to_frame(scan_map: Map, frame: str) -> NDArray[np.float64]:
    """Returns the (4, 4) ``T_frame_map`` of a named frame. Raises ConfigError for an unknown name, ExportError for a
    map without a first camera."""
    converted(Frame, frame, "frame")
    if frame == "map":
        return np.eye(4)
    if frame == "gravity":
        return scan_map.T_gravity_map
    from ..tracking.upright.upright_frame import compute_start_frame

    trajectory = scan_map.trajectory
    posed = np.flatnonzero(trajectory.has_pose)
    if not len(posed):
        raise ExportError("The map has no camera pose, so there is no first camera: use --frame gravity.")
    return compute_start_frame(scan_map.T_gravity_map, trajectory.T_world_cam[posed[0]])


def place_voxels(
    scan_map: Map,
    frame: str,
    origin: ArrayLike | None = None,
    one_size: bool = False,
    box: Box | None = None,
) -> PlacedVoxels:
    """Returns the map's voxels in a frame.

    In the map's frame, voxels keep their places, and so in the gravity frame of a map that stands upright. In another
    frame, they are resampled on a lattice of the map's (largest) voxel size. They are also resampled if ``one_size``
    asks for it, or if ``origin`` is not on the map's lattice.

    origin: (3,) lower corner of some voxel, in the frame; by default the map's lattice in the map's frame, else z = 0
    lies in the middle of a layer of voxels.  box: x0, y0, z0, x1, y1, z1 in the frame; voxels with centers outside of
    it become unknown. Raises ExportError if nothing is known, or nothing in the box.
    """
    there = _placed(scan_map, frame, origin, one_size)
    return _within(there, np.array(box).reshape(2, 3)) if box is not None else there


def _placed(scan_map: Map, frame: str, origin: ArrayLike | None, one_size: bool) -> PlacedVoxels:
    from ..occupancy.levels import make_uniform
    from ..occupancy.resampling import resample_occupancy

    occupancy, T = scan_map.occupancy, to_frame(scan_map, frame)
    if not len(occupancy.keys):
        raise ExportError("The map has no known voxels to write.")
    own = np.array_equal(T, np.eye(4)) and _on_lattice(occupancy, origin)
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
        raise ExportError(
            f"Nothing of the map lies in the box: in the {there.frame} frame the map reaches from {spans} m."
        )
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
    """Returns the height of the floor in a frame with z up, meters."""
    return float((T_frame_map @ invert(scan_map.T_gravity_map))[2, 3])


def write_description(path: Path, described: dict[str, Any]) -> None:
    """Writes ``PATH.json`` next to an export, for formats that cannot hold the frame. Raises OSError."""
    unit = "metre" if described.get("metric", True) else "unknown"
    text = json.dumps({"file": path.name, "unit": unit, **described}, indent=1)
    path.with_name(f"{path.name}.json").write_text(text + "\n", encoding="utf-8")


def find_world(scan_map: Map, T_frame_map: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the (4, 4) transform from the frame to the world of the map's ``T_world_map``."""
    return np.asarray(np.array(scan_map.manifest.T_world_map, np.float64) @ invert(T_frame_map))


def _on_lattice(occupancy: Occupancy, origin: ArrayLike | None) -> bool:
    if origin is None:
        return True
    off = (occupancy.origin - np.asarray(origin)) / occupancy.finest
    return bool(np.abs(off - np.rint(off)).max() < 1e-3)


def _nearest(occupancy: Occupancy, one: Occupancy) -> NDArray[np.int64]:
    """Returns, for each occupied voxel of ``one``, the (V,) row of the nearest occupied voxel of the original map."""
    from scipy.spatial import KDTree

    if not len(one.colors):
        return np.zeros(0, np.int64)
    tree = KDTree(occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges()))
    return np.asarray(tree.query(one.centers(one.occupied_voxels()))[1], np.int64)
