"""The frames of exports. Brings a map's voxels into one of them."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import ConfigError, ExportError
from ..core.transforms import invert
from ..core.types import BLOCK, OCCUPIED, UNKNOWN, Occupancy
from ..query.scan_map import Map
from ..settings.option_types import Finite, converted
from ..settings.typed_options import TypedOptions

Frame = Literal["map", "gravity", "start", "first-camera"]
"""The map's frame; z up with the floor at z = 0 and the walls along x and y, which is the map's own frame unless it was
made before maps stood upright; z up with the first camera at the origin and its view along x, as robots start; the
first camera's own: x right, y down, z forward."""
UprightFrame = Literal["gravity", "start"]
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
    """"gravity" (z up, floor at 0: the map's own frame if it stands upright), "map", "start" (z up, first camera at the
    origin) or "first-camera" (its own: x right, y down, z forward). Voxels keep their places only in the map's own
    frame; other frames resample them."""


@dataclass(frozen=True)
class PlacedVoxels:
    """Voxels in a frame.

    occupancy: in coordinates of the frame, without features unless it is the map's own.  rows: (V,) for each occupied
    voxel, the row of the map's occupied voxel that it stands for.  T_frame_map: (4, 4).  up: (3,) in the frame.
    metric: whether lengths are meters.
    """

    occupancy: Occupancy
    rows: NDArray[np.int64]
    frame: str
    T_frame_map: NDArray[np.float64]
    up: NDArray[np.float64]
    metric: bool

    @property
    def unit(self) -> str:
        """The unit of lengths, in words."""
        return "meters" if self.metric else "units of unknown length"

    @property
    def is_upright(self) -> bool:
        """Whether z points up."""
        return self.frame in get_args(UprightFrame) or bool(self.up[2] > 1 - 1e-9)

    def described(self) -> dict[str, Any]:
        """Returns what a reader of an export must know about its frame, as plain values."""
        return {
            "frame": self.frame,
            "T_frame_map": self.T_frame_map.tolist(),
            "voxel_size_m": self.occupancy.finest,
            "metric": self.metric,
            "up": "z" if self.is_upright else self.up.tolist(),
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

    T_first_camera = scan_map.T_first_camera
    if T_first_camera is None:
        raise ExportError("The map has no camera pose, so there is no first camera: use --frame gravity.")
    if frame == "first-camera":
        return T_first_camera
    return compute_start_frame(scan_map.T_gravity_map, invert(T_first_camera))


def place_voxels(
    scan_map: Map,
    frame: str,
    origin: ArrayLike | None = None,
    one_size: bool = False,
    box: Box | None = None,
) -> PlacedVoxels:
    """Returns the map's voxels in a frame.

    In the map's own frame, voxels keep their places. In another frame, they are resampled on a lattice of the map's
    (largest) voxel size, and cut to one size if ``one_size`` asks for it.

    origin: (3,) lower corner of some voxel, in the frame; by default the map's lattice in the map's frame, else z = 0
    lies in the middle of a layer of voxels. In the map's own frame, the frame then moves by at most half a voxel, so
    that voxels still need no resampling: ``T_frame_map`` holds the move.  box: x0, y0, z0, x1, y1, z1 in the frame;
    voxels with centers outside of it become unknown. Raises ExportError if nothing is known, or nothing in the box.
    """
    there = _placed(scan_map, frame, origin, one_size)
    return _within(there, np.array(box).reshape(2, 3)) if box is not None else there


def _placed(scan_map: Map, frame: str, origin: ArrayLike | None, one_size: bool) -> PlacedVoxels:
    from ..occupancy.levels import make_uniform
    from ..occupancy.resampling import resample_occupancy

    occupancy, T = scan_map.occupancy, to_frame(scan_map, frame).copy()
    if not len(occupancy.keys):
        raise ExportError("The map has no known voxels to write.")
    up = T[:3, :3] @ scan_map.up
    if np.array_equal(T, np.eye(4)):
        T[:3, 3] = np.zeros(3) if origin is None else _to_lattice(occupancy, np.asarray(origin, np.float64))
        own = occupancy.replace(origin=occupancy.origin + T[:3, 3])
        if not (one_size and occupancy.deepest):
            return PlacedVoxels(own, np.arange(len(own.colors)), frame, T, up, scan_map.metric)
        plain = own.replace(features=np.zeros((len(own.colors), 0), np.float16))
        one = make_uniform(plain)
        return PlacedVoxels(one, _nearest(plain, one), frame, T, up, scan_map.metric)
    plain = occupancy.replace(features=np.zeros((len(occupancy.colors), 0), np.float16))
    one = make_uniform(plain) if occupancy.deepest else plain
    at = (0.0, 0.0, -0.5 * one.voxel_size) if origin is None else origin
    new, rows = resample_occupancy(one, T, np.asarray(at, np.float64))
    rows = _nearest(plain, one)[rows] if occupancy.deepest else rows
    return PlacedVoxels(new, rows, frame, T, up, scan_map.metric)


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
    return replace(there, occupancy=part, rows=there.rows[kept])


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


def _to_lattice(occupancy: Occupancy, origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the (3,) least move that makes ``origin`` a corner of voxels of the smallest size; down, if halfway."""
    off = (occupancy.origin - origin) / occupancy.finest
    return np.asarray((np.ceil(off - 0.5 - 1e-6) - off) * occupancy.finest)


def _nearest(occupancy: Occupancy, one: Occupancy) -> NDArray[np.int64]:
    """Returns, for each occupied voxel of ``one``, the (V,) row of the nearest occupied voxel of the original map."""
    from scipy.spatial import KDTree

    if not len(one.colors):
        return np.zeros(0, np.int64)
    tree = KDTree(occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges()))
    return np.asarray(tree.query(one.centers(one.occupied_voxels()))[1], np.int64)
