"""Draws the camera path from above: keyframes, loop closures, lost and relocalized frames, and unconnected submaps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.types import Gaussians, Submap, Trajectory
from ..tracking.upright.up_direction import estimate_up
from .lettering import HEADING, LEGEND, SMALL, measure_text, write_text
from .scene_rendering import BACKGROUND, choose_cut_height, turn_upright

SIZE = 1500, 1000
"""Width and height of the picture, pixels."""

_TRACKED, _FOUND, _BETWEEN = (40, 90, 200), (240, 130, 20), (150, 90, 200)
_KEYFRAME, _HELD, _WRONG = (15, 35, 90), (0, 150, 90), (215, 40, 40)
_RULER, _FAINT = (40, 40, 40), (150, 150, 150)
_BAR, _LEGEND, _MARGIN = 56, 60, 40
_ASIDE = 360  # width of the column for unconnected submaps
_SHOWN = 3  # most of them in the picture
_HEADING_PX = 12
_DOT_M = 0.04
_RULERS_M = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


def write_path_picture(
    path: Path,
    submaps: Sequence[Submap],
    trajectory: Trajectory,
    gaussians: Gaussians,
    up: NDArray[np.float64],
    capture: Path,
    metric: bool = True,
) -> None:
    """Writes a PNG. submaps: the mapped one first; the Gaussians and (3,) ``up`` are in its world.  metric: whether
    lengths are meters. Raises OSError."""
    unit = "m" if metric else "units"
    picture = np.full((SIZE[1], SIZE[0], 3), BACKGROUND, np.uint8)
    apart = list(submaps[1:])
    width = SIZE[0] - (_ASIDE if apart else 0)
    if submaps:
        box = (0, _BAR, width, SIZE[1] - _BAR - _LEGEND)
        _draw(picture, box, submaps[0], trajectory, (gaussians, up), unit)
    rows = apart[:_SHOWN]
    for number, submap in enumerate(rows):
        height = (SIZE[1] - _BAR - _LEGEND) // len(rows)
        box = (width, _BAR + number * height, _ASIDE, height)
        _draw(picture, box, submap, trajectory, None, unit)
        label = f"apart: frames {submap.frames[0]}-{submap.frames[-1]}, {len(submap.keyframes)} keyframes"
        write_text(picture, label, (width + 12, box[1] + 18), SMALL)
    if len(apart) > _SHOWN:
        write_text(picture, f"and {len(apart) - _SHOWN} more", (width + 12, SIZE[1] - _LEGEND - 8), SMALL)
    posed = int(trajectory.has_pose.sum())
    used = int((trajectory.status != "unused").sum())
    count = f"{len(submaps)} submap{'s' if len(submaps) != 1 else ''}"
    write_text(picture, f"{capture.name}: {posed} of {used} frames with a pose, {count}, from above", (16, 36), HEADING)
    _legend(picture, submaps, trajectory)
    encoded = cv2.imencode(".png", picture[:, :, ::-1])[1]
    path.write_bytes(encoded.tobytes())


def _draw(
    picture: NDArray[np.uint8],
    box: tuple[int, int, int, int],
    submap: Submap,
    trajectory: Trajectory,
    mapped: tuple[Gaussians, NDArray[np.float64]] | None,
    unit: str,
) -> None:
    """Draws one submap from above into the box x, y, width, height. mapped: the Gaussians and the up direction, for the
    mapped submap only."""
    frames, poses, means = submap.frames, submap.T_submap_cam, np.zeros((0, 3), np.float32)
    if mapped is not None:  # includes the interpolated frames
        frames = np.flatnonzero(trajectory.has_pose).astype(np.int32)
        poses, means = trajectory.T_world_cam[frames], mapped[0].means
    at_keyframe = np.searchsorted(frames, submap.keyframes)
    up = estimate_up(poses[at_keyframe], means) if mapped is None else mapped[1]
    R = turn_upright(up, np.concatenate((means[:: max(1, len(means) // 50_000)], poses[:, :3, 3])))
    way = poses[:, :3, 3] @ R.T
    points = means @ R.T.astype(np.float32)
    extent = np.concatenate((way[:, :2], points[:, :2])).astype(np.float64)
    low, high = np.percentile(extent, (0.2, 99.8), axis=0)
    low, high = np.minimum(low, way[:, :2].min(axis=0)), np.maximum(high, way[:, :2].max(axis=0))
    x0, y0, width, height = box
    room = np.array((width - 2 * _MARGIN, height - 2 * _MARGIN))
    scale = float((room / np.maximum(high - low, 0.3)).min())
    middle = 0.5 * (low + high)

    def pixel(flat: NDArray[np.floating]) -> NDArray[np.float64]:
        """Returns the pixels of (N, 2) places in meters; y points up in the plan and down in the picture."""
        center = np.array((x0 + 0.5 * width, y0 + 0.5 * height))
        return np.asarray(center + (flat - middle) * (scale, -scale))

    if mapped is not None and len(points):
        _plan(picture, box, pixel(points[:, :2]), points[:, 2], mapped[0].colors, round(_DOT_M * scale))
    places = pixel(way[:, :2])
    ends = dict(zip(submap.keyframes.tolist(), places[at_keyframe], strict=True))
    for (a, b), held in sorted(zip(submap.closures.tolist(), submap.held.tolist(), strict=True), key=lambda c: c[1]):
        _line(picture, ends[a], ends[b], _HELD if held else _WRONG, 1)
    status = trajectory.status[frames]
    for n in range(1, len(frames)):
        between = "interpolated" in (status[n - 1], status[n])
        color = _FOUND if status[n] == "relocalised" else _BETWEEN if between else _TRACKED
        _line(picture, places[n - 1], places[n], color, 2)
    headings = (poses[at_keyframe, :3, 2] @ R.T)[:, :2] * (1, -1)
    for place, heading in zip(places[at_keyframe], headings, strict=True):
        _line(picture, place, place + _HEADING_PX * heading, _KEYFRAME, 1)
        cv2.circle(picture, _fixed(place), 3 << 3, _KEYFRAME, -1, cv2.LINE_AA, shift=3)
    for place, text, down in ((places[0], "start", -8), (places[-1], "end", 18)):
        write_text(picture, text, (int(place[0]) + 8, int(place[1]) + down), LEGEND)
    _ruler(picture, box, scale, unit)


def _plan(
    picture: NDArray[np.uint8],
    box: tuple[int, int, int, int],
    pixels: NDArray[np.float64],
    height: NDArray[np.float32],
    colors: NDArray[np.uint8],
    size: int,
) -> None:
    """Draws the room faintly from above, without its ceiling; the highest points lie on top."""
    x0, y0, width, rows = box
    size = min(max(size, 1), 6)
    u, v = np.rint(pixels - 0.5 * size).astype(int).T
    inside = (u >= x0) & (v >= y0) & (u <= x0 + width - size) & (v <= y0 + rows - size)
    shown = inside & (height < choose_cut_height(height, _DOT_M))
    order = np.flatnonzero(shown)[np.argsort(height[shown], kind="stable")]
    faint = (0.35 * colors[order] + 0.65 * np.array(BACKGROUND)).astype(np.uint8)
    for dv in range(size):
        for du in range(size):
            picture[v[order] + dv, u[order] + du] = faint


def _ruler(picture: NDArray[np.uint8], box: tuple[int, int, int, int], scale: float, unit: str) -> None:
    """Draws a ruler at the lower left of the box."""
    x0, y0, _, height = box
    meters = max((m for m in _RULERS_M if m * scale < 220), default=_RULERS_M[0])
    y, x = y0 + height - 12, x0 + 16
    cv2.line(picture, (x, y), (x + round(meters * scale), y), _RULER, 2, cv2.LINE_AA)
    write_text(picture, f"{meters:g} {unit.removesuffix('s') if meters == 1 else unit}", (x, y - 8), LEGEND)


def _legend(picture: NDArray[np.uint8], submaps: Sequence[Submap], trajectory: Trajectory) -> None:
    """Draws the meaning of the colors, with the counts."""
    held = sum(int(s.held.sum()) for s in submaps)
    wrong = sum(int((~s.held).sum()) for s in submaps)
    counts = {name: int((trajectory.status == name).sum()) for name in ("relocalised", "interpolated", "lost", "apart")}
    entries = [
        ("path", _TRACKED, True),
        (f"{sum(len(s.keyframes) for s in submaps)} keyframes with view directions", _KEYFRAME, True),
        (f"{held} loop closure{'s' if held != 1 else ''}", _HELD, held > 0),
        (f"{wrong} refused", _WRONG, wrong > 0),
        (f"{counts['relocalised']} relocalized", _FOUND, counts["relocalised"] > 0),
        (f"{counts['interpolated']} interpolated", _BETWEEN, counts["interpolated"] > 0),
        (f"{counts['lost']} lost", _FAINT, counts["lost"] > 0),
        (f"{counts['apart']} apart", _FAINT, counts["apart"] > 0),
    ]
    x, y = 16, SIZE[1] - 22
    for text, color, shown in entries:
        if shown:
            cv2.rectangle(picture, (x, y - 12), (x + 14, y + 2), color, -1)
            write_text(picture, text, (x + 22, y), LEGEND)
            x += 22 + measure_text(text, LEGEND) + 26


def _line(
    picture: NDArray[np.uint8],
    a: NDArray[np.floating],
    b: NDArray[np.floating],
    color: tuple[int, int, int],
    thickness: int,
) -> None:
    cv2.line(picture, _fixed(a), _fixed(b), color, thickness, cv2.LINE_AA, shift=3)


def _fixed(place: NDArray[np.floating]) -> tuple[int, int]:
    """Returns a pixel in OpenCV's fixed-point form, with three binary digits after the point."""
    u, v = np.rint(8 * place).astype(int).tolist()
    return u, v
