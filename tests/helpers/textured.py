"""A small scene for stereo: textured or blank rectangles, ray cast, with true depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from freeocc3d.core.transforms import invert
from freeocc3d.core.types import Intrinsics
from freeocc3d.depth.multi_view_stereo import StereoView

CAMERA = Intrinsics(160, 120, 140.0, 140.0, 79.5, 59.5)


@dataclass(frozen=True)
class Rectangle:
    """corner + s · across + t · along, 0 <= s, t <= 1; ``blank`` between these values of s, textured elsewhere."""

    corner: Sequence[float]
    across: Sequence[float]
    along: Sequence[float]
    blank: tuple[float, float] = (2.0, 2.0)
    seed: int = 0

    def seen(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distance along (H, W, 3) directions, inf where missed, and gray 0…1."""
        a, b, c = (np.asarray(v, float) for v in (self.across, self.along, self.corner))
        normal = np.cross(a, b)
        distance = ((c - origin) @ normal) / (directions @ normal)
        place = origin + distance[..., None] * directions - c
        s, t = place @ a / (a @ a), place @ b / (b @ b)
        hit = (distance > 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        gray = _noise(s * np.linalg.norm(a), t * np.linalg.norm(b), self.seed)
        return np.where(hit, distance, np.inf), np.where((s >= self.blank[0]) & (s <= self.blank[1]), 0.5, gray)


def render(
    rectangles: Sequence[Rectangle], T_world_cam: NDArray[np.float64], camera: Intrinsics = CAMERA, noise: float = 1.0
) -> tuple[StereoView, NDArray[np.float32]]:
    """The view, with ``noise`` of that many gray levels, and its true depth, 0 = nothing hit."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)), axis=-1)
    found = [r.seen(T_world_cam[:3, 3], rays @ T_world_cam[:3, :3].T) for r in rectangles]
    depths, grays = np.stack([d for d, _ in found]), np.stack([g for _, g in found])
    first = depths.argmin(axis=0)[None]
    depth = np.take_along_axis(depths, first, 0)[0]
    gray = 255.0 * np.take_along_axis(grays, first, 0)[0]
    rng = np.random.default_rng(int(1e6 * abs(T_world_cam[0, 3])) + 1)
    gray = np.clip(np.where(np.isfinite(depth), gray, 128.0) + noise * rng.normal(size=gray.shape), 0, 255)
    color = np.repeat(np.rint(gray).astype(np.uint8)[..., None], 3, axis=2)
    return StereoView(color, camera, T_world_cam), np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)


def looking(x: float, y: float = 0.0, z: float = 0.0, toward: float = 2.0) -> NDArray[np.float64]:
    """A camera at (x, y, z) that looks at (0, 0, toward)."""
    forward = np.array((0.0, 0.0, toward)) - (x, y, z)
    forward /= np.linalg.norm(forward)
    right = np.cross((0.0, 1.0, 0.0), forward)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack((right, np.cross(forward, right), forward), axis=1)
    T[:3, 3] = x, y, z
    assert np.allclose(invert(T) @ T, np.eye(4))
    return T


def _noise(x: NDArray[np.float64], y: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Smooth random gray with features of 5 and 12 cm."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(x)
    for size, weight in ((0.05, 0.5), (0.12, 0.5)):
        lattice = rng.random((64, 64))
        p, q = np.nan_to_num(x / size) % 63, np.nan_to_num(y / size) % 63
        i, j = p.astype(int), q.astype(int)
        f, g = p - i, q - j
        f, g = f * f * (3 - 2 * f), g * g * (3 - 2 * g)
        top = lattice[i, j] * (1 - f) + lattice[i + 1, j] * f
        low = lattice[i, j + 1] * (1 - f) + lattice[i + 1, j + 1] * f
        total += weight * (top * (1 - g) + low * g)
    return total
