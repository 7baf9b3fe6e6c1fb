"""The built-in room, rendered: exact poses, class images and occupancy truth; needs no download."""

from __future__ import annotations

import functools
import math
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..errors import CaptureError
from ..geometry import back_project, invert, project, transform
from ..registry import require_positive
from ..types import FREE, UNKNOWN, Frame, Intrinsics
from . import base, room

REQUIRES: tuple[str, ...] = ("open3d",)

PATH = "builtin:room"

_RATE_HZ = 30.0
_FOCAL = 0.75  # focal length over image width: 67 degrees across
_EDGE = 0.05  # relative depth step at which a sensor loses sight
_LIGHT = np.array((0.35, -0.25, 0.9)) / np.linalg.norm((0.35, -0.25, 0.9))


@dataclass(frozen=True)
class Options:
    """The walk and the camera."""

    frames: int = 240
    """Frames of one round through the room; fewer are a faster walk."""
    width: int = 320
    """Image width, pixels."""
    height: int = 240
    """Image height, pixels."""
    noise: bool = True
    """Sensor-like noise, holes and exposure changes."""
    seed: int = 0
    """Of the noise."""

    def __post_init__(self) -> None:
        require_positive(self, "frames", "width", "height")


class Reader(base.Capture):
    """A walk through the furnished room of ``room.py``. Frame i is the same whenever it is asked for."""

    format = "synthetic"
    layout = f"the name {PATH}"

    def __init__(self, path: Path, options: base.Options, own: Options):
        super().__init__(path, options)
        if str(path) != PATH:
            raise CaptureError(f"There is no built-in capture '{path}': there is {PATH}.")
        self.own = own
        self.timestamps = np.arange(own.frames) / _RATE_HZ
        self.classes = room.CLASSES
        width, height = own.width, own.height
        focal = _FOCAL * width
        self.intrinsics = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        self._lock = threading.Lock()

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return False  # it is named, never found

    def __getitem__(self, index: int) -> Frame:
        depth, triangle, _ = self._cast(index)
        color = self._shade(index, depth, triangle)
        if self.own.noise:
            depth, color = self._disturbed(index, depth, color)
        depth = np.where(depth <= self.options.max_depth, depth, 0).astype(np.float32)
        return Frame(index, float(self.timestamps[index]), color, depth, self.intrinsics)

    def pose(self, index: int) -> NDArray[np.float64]:
        return camera_on_the_walk(index / self.own.frames)

    def labels(self, index: int) -> NDArray[np.uint8]:
        _, triangle, _ = self._cast(index)
        return np.where(triangle >= 0, self._room.class_id[triangle], 0).astype(np.uint8)

    def object_image(self, index: int) -> NDArray[np.int32]:
        """(H, W) row of the object that each pixel shows, -1 for none."""
        _, triangle, _ = self._cast(index)
        return np.where(triangle >= 0, self._room.object_id[triangle], -1)

    def exact_depth(self, index: int) -> NDArray[np.float32]:
        """(H, W) metres, without noise; 0 where nothing is hit."""
        return self._cast(index)[0]

    @functools.cached_property
    def _room(self) -> _Arrays:
        return _Arrays(room.furnished())

    @functools.cached_property
    def _scene(self) -> Any:
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        vertices = self._room.triangles.reshape(-1, 3)
        faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
        scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces))
        return scene

    def _cast(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
        """Exact depth (H, W), the triangle that each pixel hits (H, W; -1 = none), and rays (H, W, 6)."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        import open3d as o3d

        camera = self.intrinsics
        v, u = np.mgrid[: camera.height, : camera.width]
        directions = back_project(np.stack((u, v), axis=-1).astype(np.float64), np.ones(u.shape), camera)
        T = self.pose(index)
        rays = np.empty((*u.shape, 6), np.float32)
        rays[..., :3], rays[..., 3:] = T[:3, 3], directions @ T[:3, :3].T
        with self._lock:
            hit = self._scene.cast_rays(o3d.core.Tensor(rays))
        depth = hit["t_hit"].numpy()  # directions have z = 1 in the camera, so the ray's parameter is the depth
        triangle = hit["primitive_ids"].numpy().astype(np.int64)
        seen = np.isfinite(depth)
        return np.where(seen, depth, 0).astype(np.float32), np.where(seen, triangle, -1), rays

    def _shade(self, index: int, depth: NDArray[np.float32], triangle: NDArray[np.int64]) -> NDArray[np.uint8]:
        _, _, rays = self._cast(index)
        points = rays[..., :3] + depth[..., None] * rays[..., 3:]
        arrays = self._room
        return _shade(
            points, triangle, depth / np.float32(self.intrinsics.fx), arrays.texture, arrays.color, arrays.second,
            arrays.scale, arrays.normal, arrays.light,
        )  # fmt: skip

    def _disturbed(
        self, index: int, depth: NDArray[np.float32], color: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Depth with the axial noise of a structured-light sensor (Nguyen, Izadi, Lovell, 3DIMPVT 2012), jitter and
        holes at edges, quantised to millimetres; colour with noise and slow changes of exposure."""
        rng = np.random.default_rng((self.own.seed, index))
        height, width = depth.shape
        shift = rng.integers(-1, 2, (2, height, width)) * (rng.random((2, height, width)) < 0.15)
        rows = np.clip(np.arange(height)[:, None] + shift[0], 0, height - 1)
        columns = np.clip(np.arange(width)[None] + shift[1], 0, width - 1)
        noisy = depth[rows, columns]
        noisy = noisy + rng.standard_normal(noisy.shape, np.float32) * (0.0012 + 0.0019 * (noisy - 0.4) ** 2)
        holes = _edges(depth) & (rng.random(depth.shape) < 0.6)
        noisy = np.where(holes | (depth <= 0.3), 0, np.rint(noisy * 1000) / 1000)
        exposure = 1.0 + 0.04 * math.sin(0.05 * index)
        lit = color * exposure + rng.standard_normal(color.shape, np.float32) * 2.0
        return noisy.astype(np.float32), np.clip(lit, 0, 255).astype(np.uint8)

    def ground_truth(self, voxel_size: float = 0.08) -> dict[str, Any]:
        """Occupancy truth with the keys of the shipped ``ground_truth.npz``: labels (X, Y, Z) uint8 (0 free, k class,
        255 not observed), origin, voxel_size, classes. A voxel is occupied if surface lies in it, of the class that
        most of its surface has; observed if some exact depth image of the walk sees it or past it (paper, supplement,
        Benchmark Details)."""
        points, classes = self._surface(voxel_size / 6)
        low = np.floor(points.min(axis=0) / voxel_size - 0.5) * voxel_size
        origin = low + (0, 0, 0.5 * voxel_size)  # the floor lies inside a voxel, not on a face between two
        index = np.floor((points - origin) / voxel_size).astype(np.int64)
        shape = tuple(int(n) for n in index.max(axis=0) + 1)
        votes = np.zeros((int(np.prod(shape)), len(room.CLASSES)), np.int32)
        np.add.at(votes, (np.ravel_multi_index(tuple(index.T), shape), classes), 1)
        labels = np.where(votes.any(axis=1), votes.argmax(axis=1), FREE).astype(np.uint8)
        labels[~self._observed(origin, shape, voxel_size)] = UNKNOWN
        return {
            "labels": labels.reshape(shape),
            "origin": origin,
            "voxel_size": voxel_size,
            "classes": np.array(room.CLASSES),
        }

    def _surface(self, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Points on all triangles, about ``spacing`` apart, and their classes."""
        rng = np.random.default_rng(0)
        a, b, c = self._room.triangles.astype(np.float64).transpose(1, 0, 2)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        which = np.repeat(np.arange(len(area)), np.ceil(2 * area / spacing**2).astype(int))
        s, t = rng.random((2, len(which), 1))
        s, t = np.where(s + t > 1, 1 - s, s), np.where(s + t > 1, 1 - t, t)
        return a[which] + s * (b - a)[which] + t * (c - a)[which], self._room.class_id[which]

    def _observed(self, origin: NDArray[np.float64], shape: tuple[int, ...], voxel_size: float) -> NDArray[np.bool_]:
        centers = origin + (np.indices(shape).reshape(3, -1).T + 0.5) * voxel_size
        observed = np.zeros(len(centers), bool)
        for index in range(0, len(self), 2):
            depth = self.exact_depth(index)
            rest = np.flatnonzero(~observed)
            pixels, z = project(transform(invert(self.pose(index)), centers[rest]), self.intrinsics)
            with np.errstate(invalid="ignore"):
                size = (self.intrinsics.width - 0.5, self.intrinsics.height - 0.5)
                inside = (pixels >= -0.5).all(axis=1) & (pixels < size).all(axis=1)
            u, v = np.rint(pixels[inside]).astype(int).T
            seen = (depth[v, u] > 0) & (z[inside] <= depth[v, u] + voxel_size) & (z[inside] <= self.options.max_depth)
            observed[rest[np.flatnonzero(inside)[seen]]] = True
        return observed


class _Arrays:
    """The room's per-triangle arrays, made once."""

    def __init__(self, furnished: room.Room):
        self.objects = furnished.objects
        self.triangles = furnished.triangles
        self.class_id, self.object_id = furnished.class_id, furnished.object_id
        self.texture, self.scale = furnished.texture, furnished.scale
        self.color, self.second = furnished.color, furnished.second
        a, b, c = self.triangles.transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        self.normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
        self.light = (0.72 + 0.28 * (self.normal @ _LIGHT)).astype(np.float32)


def camera_on_the_walk(phase: float) -> NDArray[np.float64]:
    """(4, 4) T_world_cam on a closed hand-held walk around the middle of the room, looking outwards and a little down;
    phase 0…1 is one round."""
    angle = 2 * math.pi * phase
    wave = [math.sin(k * angle + k) for k in (5, 7, 11)]
    position = np.array(
        (0.95 * math.cos(angle) + 0.02 * wave[0], 0.55 * math.sin(angle) + 0.02 * wave[1], 1.5 + 0.03 * wave[2])
    )
    yaw = angle + 0.12 * math.sin(3 * angle)
    pitch = -0.40 + 0.10 * math.sin(4 * angle + 1.0) + 0.01 * wave[2]
    forward = np.array((math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)))
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    roll = 0.02 * wave[1]
    T = np.eye(4)
    T[:3, 0] = math.cos(roll) * right + math.sin(roll) * down
    T[:3, 1] = math.cos(roll) * down - math.sin(roll) * right
    T[:3, 2], T[:3, 3] = forward, position
    return T


def _edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels beside a depth discontinuity."""
    edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        near, far = (np.moveaxis(depth, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        jump = np.abs(near - far) > _EDGE * np.minimum(near, far)
        np.moveaxis(edge, axis, 0)[:-1] |= jump
        np.moveaxis(edge, axis, 0)[1:] |= jump
    return edge


@njit(parallel=True, cache=True)
def _shade(
    points: NDArray[np.float32],
    triangle: NDArray[np.int64],
    footprint: NDArray[np.float32],
    texture: NDArray[np.int32],
    color: NDArray[np.float32],
    second: NDArray[np.float32],
    scale: NDArray[np.float32],
    normal: NDArray[np.float32],
    light: NDArray[np.float32],
) -> NDArray[np.uint8]:
    """(H, W, 3) colours of surface points: a mix of the triangle's two colours by its texture, times a fixed light, so
    that a point looks the same from everywhere. Detail finer than a pixel's footprint fades out."""
    height, width = triangle.shape
    image = np.zeros((height, width, 3), np.uint8)
    for row in prange(height):
        for column in range(width):
            t = triangle[row, column]
            if t < 0:
                continue
            x, y, z = points[row, column, 0], points[row, column, 1], points[row, column, 2]
            size = scale[t]
            fade = min(1.0, size / (3.0 * footprint[row, column] + 1e-6))
            # Two coordinates on the surface: those that are not along its normal.
            nx, ny, nz = abs(normal[t, 0]), abs(normal[t, 1]), abs(normal[t, 2])
            if nz >= nx and nz >= ny:
                a, b = x, y
            elif nx >= ny:
                a, b = y, z
            else:
                a, b = x, z
            mix = 0.0
            kind = texture[t]
            if kind == 1:  # wood: grain along a
                wobble = _noise(a / (6 * size), b / (2 * size), z, 3)
                mix = 0.5 + 0.5 * math.sin(2 * math.pi * (b / size + 1.5 * wobble))
            elif kind == 2:  # checker
                mix = float((math.floor(a / size) + math.floor(b / size)) % 2)
            elif kind == 3:  # books: each its own colour between and beyond the two
                mix = 1.6 * _hash(math.floor(a / size), math.floor(z / 0.4), 7, 5) - 0.3
            elif kind == 4:  # patches
                mix = 1.5 * _noise(a / size, b / size, z / size, 11) - 0.25
            elif kind == 5:  # plaster
                mix = _noise(a / size, b / size, z / size, 17)
            mix = 0.5 + (mix - 0.5) * fade if kind > 0 else 0.0
            grain = (_noise(x / (0.35 * size), y / (0.35 * size), z / (0.35 * size), 23) - 0.5) * min(1.0, 0.5 * fade)
            for channel in range(3):
                value = color[t, channel] + mix * (second[t, channel] - color[t, channel])
                value = (value * (1.0 + 0.18 * grain) + 6.0 * grain) * light[t]
                image[row, column, channel] = np.uint8(min(max(value, 0.0), 255.0))
    return image


@njit(cache=True)
def _hash(i: int, j: int, k: int, seed: int) -> float:
    """A number in 0…1 for each lattice point."""
    h = (i * 374761393 + j * 668265263 + k * 2147483647 + seed * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 2246822519) & 0xFFFFFFFF
    return float((h ^ (h >> 15)) & 0xFFFF) / 65535.0


@njit(cache=True)
def _noise(x: float, y: float, z: float, seed: int) -> float:
    """Value noise: lattice numbers interpolated smoothly, 0…1."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - i, y - j, z - k
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = (u if a else 1 - u) * (v if b else 1 - v) * (w if c else 1 - w)
                total += weight * _hash(int(i) + a, int(j) + b, int(k) + c, seed)
    return total
