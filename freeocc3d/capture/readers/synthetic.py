"""Renders the built-in room, with exact poses, class images and occupancy ground truth. Needs no download."""

from __future__ import annotations

import functools
import math
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numba import prange
from numpy.typing import NDArray

from ...core.compiling import njit
from ...core.depth_sensors import STRUCTURED_LIGHT
from ...core.errors import CaptureError, ConfigError
from ...core.transforms import back_project, invert
from ...core.types import FREE, UNKNOWN, Frame, Intrinsics
from ...settings.option_types import Seed
from ...settings.typed_options import TypedOptions
from .. import base
from ..builtin import builtin_room, room_shading
from ..cameras.camera_files import read_given_calibration

REQUIRES: tuple[str, ...] = ("open3d",)

PATH = "builtin:room"

_RATE_HZ = 30.0
_MOST_PIXELS = 3840 * 2160
_FOCAL_PER_WIDTH = 0.82  # a field of view of 63 degrees
_NEAREST_M = 0.3  # a depth camera measures nothing nearer
_JAGGED = 0.2  # share of edge pixels that take a neighbor's depth, each way
_EDGE_HOLES = 0.5  # share of edge pixels without depth
_MILLIMETERS = 1000  # per meter: depth is rounded to whole ones
_EXPOSURE, _EXPOSURE_RATE = 0.04, 0.05  # amplitude of the exposure, and its phase per frame, radians
_GRAY_NOISE = 2.0  # standard deviation, gray levels
_HALF_PIXEL, _FLATTEST = 0.75, 0.1
"""Largest distance from a surface point to the center of its pixel, in pixels, rounded up from 0.71; and the cosine of
the flattest view for which the change of depth over this distance is taken."""

_EDGE = 0.05  # relative depth step at which the sensor's two views disagree
_GRAZING = 0.10, 0.22  # cosines of incidence below which all, and the first, pixels are lost

Side = Annotated[int, Meta(ge=1, le=4096)]


class Options(TypedOptions, frozen=True):
    """The walk and the camera."""

    frames: Annotated[int, Meta(ge=1, le=100_000)] = 240
    """Frames of one round through the room; fewer frames mean a faster walk."""
    width: Side = 320
    """Image width, pixels."""
    height: Side = 240
    """Image height, pixels."""
    noise: bool = True
    """Whether depth and color have sensor noise; false = exact."""
    seed: Seed = 0
    """Seed of the noise."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width * self.height > _MOST_PIXELS:
            raise ConfigError(
                f"'width' and 'height' make {self.width * self.height:,} pixels, more than the {_MOST_PIXELS:,} that "
                "are rendered: choose smaller ones."
            )


@dataclass(frozen=True)
class _View:
    """What each pixel of a frame sees, exactly.

    depth_m: (H, W) meters, 0 = nothing.  triangle: (H, W) row in the room's arrays, -1 = nothing.
    points: (H, W, 3) world, meters.  cosine: (H, W) cosine of the angle of incidence, 0…1.
    """

    depth_m: NDArray[np.float32]
    triangle: NDArray[np.int32]
    points: NDArray[np.float32]
    cosine: NDArray[np.float32]


class Reader(base.Capture):
    """A hand-held walk through the furnished room of ``builtin_room.py``, at 30 Hz. A frame is always the same, at any
    time and from any thread. The world's z axis points up; its origin is the middle of the floor.

    Raises CaptureError for any path but ``builtin:room``, DependencyError if Open3D is not installed.
    """

    format = "synthetic"
    layout = f"the name {PATH}"

    def __init__(self, path: Path, options: base.Options, own: Options):
        super().__init__(path, options)
        if str(path) != PATH:
            raise CaptureError(f"There is no built-in capture '{path}': use {PATH}.")
        self.own = own
        self.has_depth = options.depth
        self.timestamps = np.arange(own.frames) / _RATE_HZ
        self.classes = builtin_room.CLASSES
        focal = _FOCAL_PER_WIDTH * own.width
        self.camera = Intrinsics(own.width, own.height, focal, focal, (own.width - 1) / 2, (own.height - 1) / 2)
        stated = read_given_calibration(options)
        self.intrinsics = stated.camera((own.width, own.height)) if stated else self.camera
        self._lock = threading.Lock()

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False  # the user names it

    def __getitem__(self, index: int) -> Frame:
        view = self._view(index)
        depth_m, color = view.depth_m, self._color(view)
        if self.own.noise:
            rng = np.random.default_rng((self.own.seed, index))
            depth_m, color = disturbed_depth(depth_m, view.cosine, rng), _disturbed_color(color, index, rng)
        farthest = self.options.max_depth if self.has_depth else 0.0
        depth_m = np.where(depth_m <= farthest, depth_m, np.float32(0))
        return Frame(index, float(self.timestamps[index]), color, depth_m, self.intrinsics)

    def pose(self, index: int) -> NDArray[np.float64]:
        return camera_on_the_walk(self._checked(index) / self.own.frames)

    def labels(self, index: int) -> NDArray[np.uint8]:
        triangle = self._view(index).triangle
        return np.where(triangle >= 0, self._room.class_ids[triangle], np.uint8(0))

    def object_image(self, index: int) -> NDArray[np.int32]:
        """(H, W) index into ``objects`` of the object at each pixel; -1 = none."""
        triangle = self._view(index).triangle
        return np.where(triangle >= 0, self._room.object_ids[triangle], np.int32(-1))

    def exact_depth(self, index: int) -> NDArray[np.float32]:
        """(H, W) meters, without noise or range limit; 0 where nothing is hit."""
        return self._view(index).depth_m

    @property
    def objects(self) -> tuple[str, ...]:
        """Class name of each object in the room."""
        return self._room.objects

    def ground_truth(self, voxel_size: float = 0.08) -> dict[str, Any]:
        """Ground truth of occupancy, from the room's exact surfaces and the parts that the selected frames see (paper,
        supplement, "Benchmark Details": every second frame, majority vote per voxel).

        A voxel with visible surface is occupied, and takes the class of most of that surface. A voxel is free if it
        holds no surface and a frame sees its center in front of the depth. All others are unknown, such as the inside
        of a cupboard. Returns the keys of the captures' ``ground_truth.npz``: labels (X, Y, Z) uint8 (0 free, k class,
        255 unknown), origin (3,) lower corner of voxel (0, 0, 0), meters, voxel_size, classes. Memory grows with 1 /
        voxel_size³: 2 cm takes about a gigabyte.
        """
        points, normals, classes = self._surface(voxel_size / 6)
        # Walls and furniture stand on whole centimeters. The shift keeps them off the faces between voxels.
        origin = points.min(axis=0).astype(np.float64) - 0.37 * voxel_size
        voxels = np.floor((points - origin) / voxel_size).astype(np.int32)
        shape = tuple(int(n) for n in voxels.max(axis=0) + 1)
        flat = np.ravel_multi_index(tuple(voxels.T), shape)
        centers = (origin + (np.indices(shape).reshape(3, -1).T + 0.5) * voxel_size).astype(np.float32)
        surface_seen, center_seen = self._seen(points, normals), self._seen(centers, None)

        labels = np.where(center_seen, FREE, UNKNOWN).astype(np.uint8)
        labels[flat] = UNKNOWN
        votes, counts = np.unique(flat[surface_seen] * len(self.classes) + classes[surface_seen], return_counts=True)
        votes = votes[np.argsort(counts, kind="stable")]  # of several classes in a voxel, the last one written wins
        labels[votes // len(self.classes)] = votes % len(self.classes)
        return {
            "labels": labels.reshape(shape),
            "origin": origin,
            "voxel_size": voxel_size,
            "classes": np.array(self.classes),
        }

    def _checked(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        return index

    @functools.cached_property
    def _room(self) -> builtin_room.Room:
        return builtin_room.build_room()

    @functools.cached_property
    def _scene(self) -> Any:
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        corners = self._room.triangles.reshape(-1, 3)
        faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
        scene.add_triangles(o3d.core.Tensor(corners), o3d.core.Tensor(faces))
        return scene

    @functools.cached_property
    def _directions_cam(self) -> NDArray[np.float32]:
        """(H, W, 3) ray directions with z = 1, so the ray parameter is the depth."""
        v, u = np.mgrid[: self.camera.height, : self.camera.width]
        pixels = np.stack((u, v), axis=-1).astype(np.float32)
        return back_project(pixels, np.ones(u.shape, np.float32), self.camera).astype(np.float32)

    def _view(self, index: int) -> _View:
        import open3d as o3d

        T_world_cam = self.pose(index).astype(np.float32)
        directions = self._directions_cam @ T_world_cam[:3, :3].T
        rays = np.concatenate((np.broadcast_to(T_world_cam[:3, 3], directions.shape), directions), axis=-1)
        with self._lock:  # the first cast builds the scene's tree, and Open3D does not guarantee thread safety
            hit = self._scene.cast_rays(o3d.core.Tensor(np.ascontiguousarray(rays)))
        depth_m = hit["t_hit"].numpy()
        seen = np.isfinite(depth_m)
        depth_m = np.where(seen, depth_m, np.float32(0))
        triangle = np.where(seen, hit["primitive_ids"].numpy().astype(np.int32), np.int32(-1))
        along = np.abs(np.einsum("hwc,hwc->hw", directions, self._room.normals[triangle]))
        points = rays[..., :3] + depth_m[..., None] * directions
        return _View(depth_m, triangle, points, along / np.linalg.norm(directions, axis=-1))

    def _color(self, view: _View) -> NDArray[np.uint8]:
        """(H, W, 3) RGB without noise."""
        r = self._room
        footprint = view.depth_m / np.float32(self.camera.fx) / np.maximum(view.cosine, np.float32(0.3))
        flat = view.points.reshape(-1, 3), view.triangle.ravel(), footprint.ravel()
        return room_shading.shade(*flat, r.textures, r.colors, r.scales, r.normals).reshape(*view.depth_m.shape, 3)

    def _surface(self, spacing: float) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
        """Random points on all triangles, one per ``spacing``² m²: (P, 3) world points, (P, 3) normals, (P,) class
        ids."""
        rng = np.random.default_rng(0)
        a, b, c = self._room.triangles.astype(np.float64).transpose(1, 0, 2)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        which = np.repeat(np.arange(len(area)), np.ceil(area / spacing**2).astype(int))
        s, t = rng.random((2, len(which), 1))
        s, t = np.where(s + t > 1, 1 - s, s), np.where(s + t > 1, 1 - t, t)
        points = a[which] + s * (b - a)[which] + t * (c - a)[which]
        return points.astype(np.float32), self._room.normals[which], self._room.class_ids[which]

    def _seen(self, points: NDArray[np.float32], normals: NDArray[np.float32] | None) -> NDArray[np.bool_]:
        """(P,) whether any of every second selected frame sees the world point: at or before the exact depth, within
        the sensor's range, and from the front if the point has a normal."""
        seen = np.zeros(len(points), bool)
        facing = np.zeros((0, 3), np.float32) if normals is None else normals
        used = range(len(self))[self.options.start : self.options.stop : self.options.stride]
        for index in used[::2]:
            T_cam_world = invert(self.pose(index))
            depth_m = self.exact_depth(index)
            depth_m = np.where(depth_m > 0, np.minimum(depth_m, np.float32(self.options.max_depth)), np.float32(0))
            _mark_seen(points, facing, T_cam_world, self.camera.matrix, depth_m, seen)
        return seen


def camera_on_the_walk(phase: float) -> NDArray[np.float64]:
    """(4, 4) T_world_cam on a closed hand-held walk; phase 0…1 is one round. The walk goes clockwise while the camera
    turns left: it faces the table and the door from near, and looks across the room along the other two walls."""
    angle = 2 * math.pi * phase
    sway = [math.sin(k * angle + k) for k in (5, 7, 11)]
    position = np.array((0.12 + 0.95 * math.cos(angle), -0.85 * math.sin(angle) - 0.05, 1.5))
    position += np.array((0.02, 0.02, 0.03)) * sway
    yaw = angle + 0.08 * math.sin(3 * angle)
    pitch = -0.42 - 0.09 * math.cos(2 * angle) + 0.06 * math.sin(3 * angle + 1.0) + 0.01 * sway[2]
    pitch += 0.34 * math.exp(-(((angle - 2.2) / 0.55) ** 2))  # a glance up at the wardrobe and the ceiling
    forward = np.array((math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)))
    right = np.array((math.sin(yaw), -math.cos(yaw), 0.0))
    down = np.cross(forward, right)
    roll = 0.02 * sway[1]
    T_world_cam = np.eye(4)
    T_world_cam[:3, 0] = math.cos(roll) * right + math.sin(roll) * down
    T_world_cam[:3, 1] = math.cos(roll) * down - math.sin(roll) * right
    T_world_cam[:3, 2], T_world_cam[:3, 3] = forward, position
    return T_world_cam


def disturbed_depth(
    depth_m: NDArray[np.float32], cosine: NDArray[np.float32], rng: np.random.Generator
) -> NDArray[np.float32]:
    """Add sensor errors to (H, W) exact depth: jagged edges, axial noise, rounding to millimeters, and holes (0) at
    edges, at grazing incidence and nearer than 0.3 m. cosine: (H, W) cosine of the angle of incidence."""
    height, width = depth_m.shape
    shift = rng.integers(-1, 2, (2, height, width)) * (rng.random((2, height, width), np.float32) < _JAGGED)
    rows = np.clip(np.arange(height)[:, None] + shift[0], 0, height - 1)
    columns = np.clip(np.arange(width)[None] + shift[1], 0, width - 1)
    edges = _edges(depth_m)
    noisy = np.where(edges, depth_m[rows, columns], depth_m)
    noisy = noisy + STRUCTURED_LIGHT.compute_sigma(noisy) * rng.standard_normal(noisy.shape, np.float32)
    chance = np.where(edges, _EDGE_HOLES, np.clip((_GRAZING[1] - cosine) / (_GRAZING[1] - _GRAZING[0]), 0, 1))
    holes = (rng.random(depth_m.shape, np.float32) < chance) | (depth_m < _NEAREST_M)
    return np.where(holes, 0, np.rint(noisy * _MILLIMETERS) / _MILLIMETERS).astype(np.float32)


def _disturbed_color(color: NDArray[np.uint8], index: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Add noise of two gray levels, and an exposure that varies slowly by 4 %."""
    exposure = np.float32(1.0 + _EXPOSURE * math.sin(_EXPOSURE_RATE * index))
    noisy = color * exposure + _GRAY_NOISE * rng.standard_normal(color.shape, np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _edges(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) whether a pixel lies next to a depth step."""
    edges = np.zeros(depth_m.shape, bool)
    for axis in (0, 1):
        # Views: writing to along_axis changes edges.
        along_axis, depths = np.moveaxis(edges, axis, 0), np.moveaxis(depth_m, axis, 0)
        step = np.abs(np.diff(depths, axis=0)) > _EDGE * np.minimum(depths[:-1], depths[1:])
        along_axis[:-1] |= step
        along_axis[1:] |= step
    return edges


@njit(parallel=True, cache=True)
def _mark_seen(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    T_cam_world: NDArray[np.float64],
    K: NDArray[np.float64],
    depth_m: NDArray[np.float32],
    seen: NDArray[np.bool_],
) -> None:
    """Set ``seen`` (P,) for world points (P, 3) that a depth image (H, W) does not hide. normals: (P, 3) surface
    normals, which must face the camera; (0, 3) = the points lie on no surface."""
    height, width = depth_m.shape
    R, t = T_cam_world[:3, :3], T_cam_world[:3, 3]
    for p in prange(len(points)):
        if seen[p]:
            continue
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        cx = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
        cy = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
        cz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        if cz <= 0:
            continue
        column, row = round(K[0, 0] * cx / cz + K[0, 2]), round(K[1, 1] * cy / cz + K[1, 2])
        if not (0 <= column < width and 0 <= row < height):
            continue
        tolerance = 0.0
        if len(normals) > 0:
            nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
            facing = 0.0
            for axis, along in enumerate((cx, cy, cz)):
                facing -= along * (R[axis, 0] * nx + R[axis, 1] * ny + R[axis, 2] * nz)
            cosine = facing / math.sqrt(cx * cx + cy * cy + cz * cz)
            if cosine <= 0:
                continue
            # the change of the surface's depth within a pixel
            tolerance = _HALF_PIXEL * cz / K[0, 0] / max(cosine, _FLATTEST)
        if cz <= depth_m[row, column] + tolerance and depth_m[row, column] > 0:
            seen[p] = True
