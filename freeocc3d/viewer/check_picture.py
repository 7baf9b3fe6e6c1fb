"""Draws where the depth images of a map disagree: the rooms from above, and the pairs of keyframes that differ most."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.atomic_files import write_whole
from ..core.sampling import spread_evenly
from ..core.transforms import invert, transform
from ..core.voxel_keys import pack_voxels
from ..query.scan_map import Map
from ..tracking.view_agreement import Agreement, ComparedView, PairAgreement, compare_views
from .floor_plans import FloorPlan
from .lettering import HEADING, LEGEND, write_text
from .scene_rendering import BACKGROUND

SIZE = 1600, 960
"""Width and height of the picture, pixels."""

WORST = 4
"""Pairs that are shown beside the plan."""

_PLAN, _BAR, _MARGIN, _LEGEND = 860, 56, 30, 60  # width of the plan; the heading; around the plan; below it
_PAIRS = 150  # of each kind whose points are drawn, evenly chosen
_CELL, _LEAST = 2, 5  # voxels along a cell, and points of a cell, whose median is drawn
_TOP = 4.0  # the color scale ends at this multiple of the median of all pairs
_COLUMNS = 120  # sampled points along a row of a shown pair
_UNKNOWN, _PATH = (222, 222, 222), (90, 90, 90)


def write_check_picture(
    scan_map: Map,
    views: Sequence[ComparedView],
    agreement: Agreement,
    path: Path,
    overwrite: bool = False,
) -> None:
    """Write a PNG. views: of the keyframes.  agreement: their compared pairs. Raises ExportError, MapError."""
    picture = np.full((SIZE[1], SIZE[0], 3), BACKGROUND, np.uint8)
    pairs = [*agreement.revisits, *agreement.steps]
    top = _TOP * float(np.median([pair.off_m for pair in pairs])) if pairs else 0.0
    name = Path(scan_map.manifest.capture.path).name
    write_text(picture, f"{name}: where the depth of keyframes differs, from above", (16, 36), HEADING)
    if pairs and top > 0:
        _draw_plan(picture, scan_map, views, agreement, top)
        worst = sorted(agreement.revisits or agreement.steps, key=lambda pair: -pair.off_m)[:WORST]
        for number, pair in enumerate(worst):
            _draw_pair(picture, scan_map, views, pair, top, number)
        _draw_scale(picture, top, scan_map.metric)
    encoded = cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes()

    def write(target: Path) -> None:
        target.write_bytes(encoded)

    write_whole(path, write, overwrite)


def measure_cells(
    views: Sequence[ComparedView], T_world_cam: NDArray[np.float64], pairs: Sequence[PairAgreement], edge: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Ascending packed keys of the cells of a lattice through the origin that hold enough compared points, and the
    median of |r| in each. edge: of a cell, meters."""
    keys, off = [], []
    for pair in pairs:
        T_target_source = invert(T_world_cam[pair.target]) @ T_world_cam[pair.source]
        found = compare_views(views[pair.source], views[pair.target], T_target_source)
        points = transform(T_world_cam[pair.source], found.points)
        keys.append(pack_voxels(np.floor(points / edge).astype(np.int64)))
        off.append(np.abs(found.off_m))
    key, value = np.concatenate(keys), np.concatenate(off)
    order = np.lexsort((value, key))
    cells, first, count = np.unique(key[order], return_index=True, return_counts=True)
    enough = count >= _LEAST
    return cells[enough], value[order][(first + count // 2)[enough]]


def _look_up(
    cells: NDArray[np.int64], off: NDArray[np.float64], centers: NDArray[np.float64], edge: float
) -> NDArray[np.float64]:
    """(V,) medians of the cells of (V, 3) voxel centers, or else of a cell within half an edge; NaN where there is
    none. A surface may lie beside its voxel's center, on the other side of a cell's face."""
    found = np.full(len(centers), np.nan)
    for shift in (np.zeros((1, 3)), 0.5 * edge * np.eye(3), -0.5 * edge * np.eye(3)):
        for step in shift:
            missing = np.flatnonzero(np.isnan(found))
            wanted = pack_voxels(np.floor((centers[missing] + step) / edge).astype(np.int64))
            place = np.searchsorted(cells, wanted)
            known = np.append(cells, -1)[place] == wanted
            found[missing[known]] = off[place[known]]
    return found


def _draw_plan(
    picture: NDArray[np.uint8], scan_map: Map, views: Sequence[ComparedView], agreement: Agreement, top: float
) -> None:
    """Draw the occupied voxels from above, the highest below the cut on top, and the camera's path."""
    occupancy, trajectory = scan_map.occupancy, scan_map.trajectory
    centers = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges())
    chosen = [kind[row] for kind in (agreement.revisits, agreement.steps) for row in spread_evenly(len(kind), _PAIRS)]
    edge = _CELL * occupancy.voxel_size
    cells, off = measure_cells(views, trajectory.T_world_keyframe, chosen, edge)
    colors = np.full((len(centers), 3), _UNKNOWN, np.uint8)
    found = _look_up(cells, off, centers, edge)
    colors[np.isfinite(found)] = _colors(found[np.isfinite(found)], top)

    plan = FloorPlan(scan_map, (0, _BAR, _PLAN, SIZE[1] - _LEGEND), _MARGIN)
    plan.draw_voxels(picture, plan.drawn, colors[plan.drawn])
    way = plan.pixel(trajectory.T_world_cam[trajectory.has_pose][:, :3, 3])
    cv2.polylines(picture, [np.rint(8 * way).astype(np.int32)], False, _PATH, 1, cv2.LINE_AA, shift=3)


def _draw_pair(
    picture: NDArray[np.uint8],
    scan_map: Map,
    views: Sequence[ComparedView],
    pair: PairAgreement,
    top: float,
    number: int,
) -> None:
    """Draw two keyframes, and the residuals of the first one's points."""
    T = scan_map.trajectory.T_world_keyframe
    source, target = views[pair.source], views[pair.target]
    found = compare_views(source, target, invert(T[pair.target]) @ T[pair.source], _COLUMNS)
    faint = (0.3 * source.gray[..., None] + 0.7 * np.array(BACKGROUND)).astype(np.uint8)
    step = max(1, source.camera.width // _COLUMNS)
    colors = _colors(np.abs(found.off_m), top)
    for dv in range(step):
        for du in range(step):
            rows = np.minimum(found.pixels + (dv, du), np.array(source.gray.shape) - 1)
            faint[tuple(rows.T)] = colors
    panels = [source.gray[..., None].repeat(3, axis=2), target.gray[..., None].repeat(3, axis=2), faint]
    room = (SIZE[0] - _PLAN - _MARGIN) // len(panels), (SIZE[1] - _BAR - _LEGEND) // WORST
    for column, panel in enumerate(panels):
        scale = min((room[0] - 8) / panel.shape[1], (room[1] - 36) / panel.shape[0])
        size = max(1, int(scale * panel.shape[1])), max(1, int(scale * panel.shape[0]))
        x, y = _PLAN + column * room[0], _BAR + number * room[1]
        picture[y : y + size[1], x : x + size[0]] = cv2.resize(panel, size, interpolation=cv2.INTER_AREA)
        below = y + size[1] + 18
    frames = scan_map.manifest.keyframes
    said = f"frames {frames[pair.source]} and {frames[pair.target]}: {_length(pair.off_m, scan_map.metric)}"
    write_text(picture, said, (_PLAN, below), LEGEND)


def _draw_scale(picture: NDArray[np.uint8], top: float, metric: bool) -> None:
    ramp = _colors(np.linspace(0, top, 240), top)
    y = SIZE[1] - 34
    picture[y : y + 14, 16 : 16 + len(ramp)] = ramp
    said = f"0 to {_length(top, metric)}; gray: seen by no two compared keyframes"
    write_text(picture, said, (16 + len(ramp) + 12, y + 12), LEGEND)


def _colors(off: NDArray[np.float64], top: float) -> NDArray[np.uint8]:
    """(N, 3) colors of residuals: small is blue, large is red."""
    level = np.rint(255 * np.clip(off / top, 0, 1)).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(level[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1], np.uint8)


def _length(value: float, metric: bool) -> str:
    return f"{100 * value:.1f} cm" if metric else f"{value:.2g} units"
