"""Finds the frame in which a map stands upright: z up, the floor at z = 0, the walls along x and y.

What is level decides: the floor's plane; without a floor other level surfaces, or else the walls; without any of them
the cameras, which people hardly roll.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.transforms import invert
from ...core.types import Gaussians
from .surface_patches import CELL_M, SurfacePatches
from .up_direction import estimate_camera_up, look_one_way

FLOOR, LEVELS, WALLS, CAMERAS, ONE_VIEW = "floor", "level surfaces", "walls", "cameras", "one view"
"""What up comes from, the surest first."""

_SAMPLES = 20_000
_NEIGHBORS = 24
_FLAT = 0.3  # greatest thickness of flat surroundings, as a share of their width
_LEVEL = np.cos(np.deg2rad(20.0))  # a normal within this angle of up belongs to a level surface
_UPRIGHT = np.sin(np.deg2rad(15.0))  # … and a normal below this to a wall
_BIN, _THIN = 0.02, 0.005  # meters: bins of heights, and of the places of walls
_FLOOR_SHARE = 0.25  # of the largest level surface below the cameras: a smaller surface is not a floor
_BAND = (0.08, 0.05, 0.03)  # meters around the floor: points within them fit the plane, band after band
_LARGEST_TURN = np.deg2rad(3.0)
_BELOW_CAMERA = 0.2  # meters: least height of the camera above the floor
_SMOOTHING = (0.25, 0.5, 1.0, 0.5, 0.25)  # smooths the histogram of heights, so that noise makes no peaks
_LEAST_FLOOR = 10  # smallest number of points for the floor's plane
_LEAST_PATCHES = round(0.25 / CELL_M**2)  # a quarter of a square meter: less shows neither walls nor what is level
_BANDS_DEG = (20.0, 10.0, 5.0, 3.0)  # largest slope of level surfaces, and of walls from upright, round after round
_PITCHES_DEG = (0.0, -15.0, 15.0, -30.0, 30.0, -45.0)
"""Turns of the cameras' up toward their view to try; the last one for tables, at which people look steeply down."""
_CLEARLY = 1.5  # how much more must speak for one of them than for no turn
_TINY = 1e-9  # avoids division by 0 where the cameras' x axes cancel out
_OPEN = 0.1  # smallest share of them that must speak against the next best direction
_NEAR_PEAK_DEG = 3.0  # largest angle from the peak of the walls' directions for the median
_REACHES_DEG, _TURNS = (1.0, 0.25, 0.06), 11  # largest turn of x, round after round, and the number of turns to try
_DIAGONAL = np.sqrt(0.5)  # a normal nearer to x than this belongs to a wall across x, else to one across y
_SQUARE = 0.3
"""Smallest share of walls within 3 degrees of the common directions: walls of any direction reach a fifteenth."""
_STEEP = 0.95  # cosine, 18 degrees: a camera nearer to straight down or up has no heading
_EXTENT = 0.3
"""Meters: least standard deviation of a floor's points along its narrow side, of a floor that is a meter wide; a
narrower floor shows no tilt."""


@dataclass(frozen=True)
class UprightFrame:
    """The frame with z up, z = 0 on the floor, x = y = 0 below the first camera, and x along the walls in the direction
    nearest to that camera's view.

    T_upright_world: (4, 4), rigid.
    by: what up comes from: "floor", "level surfaces", "walls", "cameras", or "one view": cameras that all look the same
    way, which tell no pitch.  off_deg: degrees from that up to the up of the cameras; for the cameras alone, by how
    much they were rolled.
    floor: whether z = 0 is a floor, or else the level of the lowest points.
    walls: whether x lies along walls, or else along the first camera's view.
    """

    T_upright_world: NDArray[np.float64]
    by: str
    off_deg: float
    floor: bool
    walls: bool

    def evidence(self) -> dict[str, Any]:
        """How sure the frame is, as plain values."""
        return {name: value for name, value in vars(self).items() if name != "T_upright_world"}

    def to_array(self) -> NDArray[np.str_]:
        """The frame as a plain array, for saving."""
        return np.array(json.dumps({**self.evidence(), "T_upright_world": self.T_upright_world.tolist()}))

    @classmethod
    def from_array(cls, array: NDArray[Any]) -> UprightFrame:
        """The inverse of ``to_array``."""
        values = json.loads(str(array))
        return cls(**{**values, "T_upright_world": np.array(values["T_upright_world"])})


def find_upright_frame(T_world_cam: NDArray[np.float64], patches: SurfacePatches) -> UprightFrame:
    """Returns the upright frame of a scan, from (K, 4, 4) poses as people held the cameras, and what they saw. The
    floor is the lowest of the large level surfaces below the cameras."""
    if len(T_world_cam) == 0:
        T_world_cam = np.eye(4)[None]
    centers = T_world_cam[:, :3, 3]
    by_cameras, off_deg = estimate_camera_up(T_world_cam)
    by_normals = _find_by_normals(by_cameras, T_world_cam[:, :3, 0].mean(axis=0), patches.normals)
    near = by_cameras if by_normals is None else by_normals
    by_floor, height = _find_floor(near, patches, centers)
    up, by = by_cameras, ONE_VIEW if look_one_way(T_world_cam) else CAMERAS
    if by_floor is not None:
        up, by = by_floor, FLOOR
    elif by_normals is not None:
        level = patches[np.abs(patches.normals @ by_normals) > _LEVEL]
        up, by = (_fit_levels(near, level.points), LEVELS) if len(level) >= _LEAST_PATCHES else (by_normals, WALLS)
    if by not in (CAMERAS, ONE_VIEW):
        off_deg = float(np.degrees(np.arccos(np.clip(up @ by_cameras, -1, 1))))
    if height is None:
        z0 = float(np.percentile(patches.points @ up if len(patches) else centers @ up, 1))
    else:
        at = patches.points[(patches.normals @ up > _LEVEL) & (np.abs(patches.points @ near - height) < _BAND[0])]
        z0 = float(np.median(at @ up))
    x, along_walls = _find_heading(up, T_world_cam[0], patches)
    R = np.stack((x, np.cross(up, x), up))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, (*(-R[:2] @ centers[0]), -z0)
    return UprightFrame(T, by, off_deg, height is not None, along_walls)


def estimate_gravity_frame(T_map_cam: NDArray[np.float64], gaussians: Gaussians) -> NDArray[np.float64]:
    """Returns the (4, 4) rigid ``T_gravity_map`` to the upright frame of a map, from (K, 4, 4) poses of its keyframes
    and its Gaussians."""
    return find_upright_frame(T_map_cam, find_flat_gaussians(gaussians, T_map_cam)).T_upright_world


def compute_start_frame(T_upright_map: NDArray[np.float64], T_map_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the (4, 4) rigid ``T_start_map``: z up, the origin at the center of the camera ``T_map_cam`` (4, 4), x
    along its view. Robots use the same convention for their start."""
    T_upright_cam = T_upright_map @ T_map_cam
    x = _heading(np.array((0.0, 0.0, 1.0)), T_upright_cam[:3, 2], -T_upright_cam[:3, 1])
    T_upright_start = np.eye(4)
    T_upright_start[:3, :3] = np.stack((x, (-x[1], x[0], 0.0), (0.0, 0.0, 1.0)), axis=1)
    T_upright_start[:3, 3] = T_upright_cam[:3, 3]
    return np.asarray(invert(T_upright_start) @ T_upright_map)


def estimate_floor_height(heights: NDArray[np.float64], camera_height: float) -> float | None:
    """Returns the height of the floor from the (N,) heights of points on level surfaces. It is the lowest peak of their
    histogram below the cameras with at least a quarter of the largest peak's points. None if hardly any points lie
    below the cameras: the noise of a wall makes some."""
    below = heights[heights < camera_height - _BELOW_CAMERA]
    return float(_find_peaks(below, _FLOOR_SHARE)[0]) if len(below) >= _LEAST_PATCHES else None


def _find_peaks(heights: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Returns the places, ascending, of the peaks of the histogram of (N,) heights, N > 0, that reach a share of the
    largest."""
    low = float(heights.min())
    count = np.bincount(((heights - low) / _BIN).astype(np.int64), minlength=len(_SMOOTHING)).astype(np.float64)
    smooth = np.convolve(count, _SMOOTHING, "same")
    padded = np.pad(smooth, 1)
    is_peak = (smooth >= padded[:-2]) & (smooth >= padded[2:]) & (smooth >= share * smooth.max())
    return np.asarray(low + (np.flatnonzero(is_peak) + 0.5) * _BIN)


def find_flat_gaussians(gaussians: Gaussians, T_map_cam: NDArray[np.float64]) -> SurfacePatches:
    """Returns patches at Gaussians that lie on something flat, from a sample spread evenly over storage, with the
    normals of planes through their neighbors, toward the cameras (K, 4, 4) that they are anchored to. Gaussians have no
    normals: by default they are spheres."""
    from scipy.spatial import KDTree

    means = gaussians.means
    if len(means) < _NEIGHBORS:
        return SurfacePatches(np.zeros((0, 3)), np.zeros((0, 3)))
    rows = slice(None, None, max(1, len(means) // _SAMPLES))
    points = means[rows].astype(np.float64)
    near = means[KDTree(means).query(points, _NEIGHBORS)[1]].astype(np.float64)
    off = near - near.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", off, off))
    flat = spread[:, 0] < _FLAT**2 * spread[:, 1]
    normals = axes[:, :, 0]
    to_camera = T_map_cam[gaussians.anchor_keyframe[rows], :3, 3] - points
    normals = normals * np.where((normals * to_camera).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    return SurfacePatches(points[flat], normals[flat])


def _find_floor(
    up: NDArray[np.float64], patches: SurfacePatches, centers: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, float | None]:
    """Returns the floor's normal and its height along ``up``. The normal comes from a least-squares plane through the
    points near the floor, in ever narrower bands. It is None where the points do not spread in both directions or would
    turn it by more than 3 degrees; both are None without a floor."""
    level = patches.points[patches.normals @ up > _LEVEL]
    lowest = estimate_floor_height(level @ up, float(np.median(centers @ up)))
    if lowest is None:
        return None, None
    normal, height, fits = up, lowest, False
    for band in _BAND:
        near = level[np.abs(level @ normal - height) < band]
        if len(near) < _LEAST_FLOOR:
            return None, lowest
        center = near.mean(axis=0)
        spread, axes = np.linalg.eigh(_sum_products(near - center) / len(near))
        fitted = axes[:, 0] * np.sign(axes[:, 0] @ up)
        fits = bool(spread[1] > _EXTENT**2 and fitted @ up > np.cos(_LARGEST_TURN))
        normal = fitted if fits else normal
        height = float(center @ normal)
    return (normal if fits else None), lowest


def _fit_levels(up: NDArray[np.float64], level: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the common normal of the level surfaces that (N, 3) points show, by least-squares planes through the
    points near each peak of their heights. It is ``up`` where they do not spread in both directions."""
    for band in _BAND[1:]:
        heights = level @ up
        peaks = _find_peaks(heights, _FLOOR_SHARE)
        layer = np.searchsorted(0.5 * (peaks[1:] + peaks[:-1]), heights)
        near = np.abs(heights - peaks[layer]) < band
        points, layer = level[near], layer[near]
        count = np.maximum(np.bincount(layer, minlength=len(peaks)), 1)
        centers = np.stack([np.bincount(layer, points[:, i], len(peaks)) / count for i in range(3)], axis=1)
        spread, axes = np.linalg.eigh(_sum_products(points - centers[layer]) / max(len(points), 1))
        fitted = axes[:, 0] * np.sign(axes[:, 0] @ up)
        if spread[1] <= _EXTENT**2 or fitted @ up < np.cos(_LARGEST_TURN):
            return up
        up = fitted
    return up


def _find_by_normals(
    up: NDArray[np.float64], sideways: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Returns the up of the level surfaces and walls that (P, 3) normals show, near the cameras' ``up``. If all cameras
    look the same way, they do not tell their pitch: an up that is pitched about the (3,) mean of their x axes is taken
    if clearly more normals agree with it."""
    tried = [_fit_normals(_pitched(up, sideways, degrees), normals) for degrees in _PITCHES_DEG]
    found = [fitted for fitted in tried if fitted is not None]
    if not found:
        return None
    near = np.sin(np.deg2rad(_BANDS_DEG[-1]))
    along = [np.abs(normals @ fitted) for fitted in found]
    agreeing = [int(((off < near) | (off > np.sqrt(1 - near**2))).sum()) for off in along]
    if tried[0] is not None and agreeing[0] * _CLEARLY > max(agreeing):
        return tried[0]
    return found[int(np.argmax(agreeing))]


def _pitched(up: NDArray[np.float64], sideways: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Returns ``up`` turned toward or from the view of cameras whose x axis is ``sideways``."""
    ahead = np.cross(up, sideways)
    ahead /= max(float(np.linalg.norm(ahead)), _TINY)
    return np.asarray(np.cos(np.deg2rad(degrees)) * up + np.sin(np.deg2rad(degrees)) * ahead)


def _fit_normals(up: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Returns the direction along which (P, 3) normals of level surfaces lie most and those of walls least, in ever
    narrower bands around ``up``. None where they leave it open, as a single wall does."""
    for degrees in _BANDS_DEG:
        off = np.deg2rad(degrees)
        level, walls = normals[np.abs(normals @ up) > np.cos(off)], normals[np.abs(normals @ up) < np.sin(off)]
        if len(level) + len(walls) < _LEAST_PATCHES:
            return None
        spread, axes = np.linalg.eigh(_sum_products(walls) - _sum_products(level))
        if spread[1] - spread[0] < _OPEN * (len(level) + len(walls)):
            return None
        up = axes[:, 0] * np.sign(axes[:, 0] @ up)
    return up


def _sum_products(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the (3, 3) sum of v v^T over (N, 3) vectors, in one order by any number of threads."""
    return np.asarray(np.einsum("ni,nj->ij", vectors, vectors))


def _find_heading(
    up: NDArray[np.float64], T_world_cam: NDArray[np.float64], patches: SurfacePatches
) -> tuple[NDArray[np.float64], bool]:
    """Returns the (3,) level unit vector along the walls that is nearest to a camera's view, and whether there are such
    walls. It comes from the peak of the walls' normals, folded into a quarter turn, and is then turned to where the
    walls' places have the sharpest histogram. Without walls it is the camera's view."""
    x = _heading(up, T_world_cam[:3, 2], -T_world_cam[:3, 1])
    walls = patches[np.abs(patches.normals @ up) < _UPRIGHT]
    if len(walls) < _LEAST_PATCHES:
        return x, False
    quarter = np.degrees(np.arctan2(walls.normals @ np.cross(up, x), walls.normals @ x)) % 90.0
    count = np.bincount(quarter.astype(np.int64) % 90, minlength=90)
    piled = sum(np.roll(count, shift) for shift in range(-2, 3))
    peak = int(np.argmax(piled)) + 0.5
    off = (quarter - peak + 45.0) % 90.0 - 45.0
    along = np.abs(off) < _NEAR_PEAK_DEG
    if along.mean() < _SQUARE:
        return x, False
    x = _turned(up, x, (peak + float(np.median(off[along])) + 45.0) % 90.0 - 45.0)
    for reach_deg in _REACHES_DEG:
        x = _most_aligned(up, x, walls[along], reach_deg)
    return x, True


def _most_aligned(
    up: NDArray[np.float64], x: NDArray[np.float64], walls: SurfacePatches, reach_deg: float
) -> NDArray[np.float64]:
    """Returns ``x`` turned about ``up`` by at most ``reach_deg`` to where the places of walls across x and y have the
    sharpest histogram: the greatest sum of squared counts."""
    turns = [_turned(up, x, degrees) for degrees in np.linspace(-reach_deg, reach_deg, _TURNS)]
    across_x = np.abs(walls.normals @ x) > _DIAGONAL
    piled = []
    for turned in turns:
        places = np.where(across_x, walls.points @ turned, walls.points @ np.cross(up, turned))
        layers = np.floor(places / _THIN).astype(np.int64)
        piled.append(sum(_sharpness(layers[chosen]) for chosen in (across_x, ~across_x) if chosen.any()))
    return turns[int(np.argmax(piled))]


def _sharpness(layers: NDArray[np.int64]) -> float:
    count = np.bincount(layers - layers.min(), minlength=len(_SMOOTHING)).astype(np.float64)
    return float((np.convolve(count, _SMOOTHING) ** 2).sum())


def _turned(up: NDArray[np.float64], x: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Returns a level ``x`` turned about ``up``."""
    turn = np.deg2rad(degrees)
    return np.asarray(np.cos(turn) * x + np.sin(turn) * np.cross(up, x))


def _heading(up: NDArray[np.float64], forward: NDArray[np.float64], above: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the (3,) level unit vector along a camera's view. If the camera looks straight down or up, it points to
    the top or bottom edge of its image."""
    looks = forward if abs(forward @ up) < _STEEP else above * -np.sign(forward @ up)
    flat = looks - (looks @ up) * up
    return np.asarray(flat / np.linalg.norm(flat))
