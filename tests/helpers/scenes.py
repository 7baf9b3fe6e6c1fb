"""Analytic scenes for tests: Gaussians, depth images and occupancy with known answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from freeocc3d.core.types import Frame, Gaussians, Intrinsics, Occupancy, PosedFrame
from freeocc3d.gaussians import anchors

CAMERA = Intrinsics(160, 120, 130.0, 130.0, 79.5, 59.5)


def gaussians(means: object, scales: object, quats: object = None, opacities: object = None) -> Gaussians:
    """Gaussians at (N, 3) means; scales (N, 3) or one number; rotations default to none, opacities to 0.9."""
    means = np.atleast_2d(np.asarray(means, np.float32))
    n = len(means)
    identity = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    return Gaussians(
        means=means,
        scales=np.broadcast_to(np.asarray(scales, np.float32), (n, 3)).copy(),
        quats_wxyz=identity if quats is None else np.atleast_2d(np.asarray(quats, np.float32)),
        opacities=np.full(n, 0.9, np.float32) if opacities is None else np.asarray(opacities, np.float32),
        colors=np.full((n, 3), 128, np.uint8),
        anchor_keyframe=np.zeros(n, np.int32),
        anchor_cam=means.copy(),
    )


def random_gaussians(n: int, seed: int, extent: float = 1.0) -> Gaussians:
    """Gaussians of random shape, rotation and opacity in a cube around the origin."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return gaussians(
        rng.uniform(-extent / 2, extent / 2, (n, 3)),
        rng.uniform(0.01, 0.06, (n, 3)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        rng.uniform(0.1, 1.0, n),
    )


def posed(frames, poses) -> list[PosedFrame]:
    """Keyframes at their poses."""
    return [PosedFrame(frame, T, row) for row, (frame, T) in enumerate(zip(frames, poses, strict=True))]


def lifted(frames, poses, cell: float = 0.04, **options) -> Gaussians:
    """Gaussians anchored to keyframes."""
    cells = anchors.AnchoredCells(anchors.Options(**options), cell, np.stack(poses))
    looks = posed(frames, poses)
    for look in looks:
        cells.add(look)
    return cells.gaussians(looks)


def wall_frame(distance: float, index: int = 0, camera: Intrinsics = CAMERA, seed: int | None = None) -> Frame:
    """A camera that looks straight at a textured wall; with a seed, depth has sensor-like noise."""
    rng = np.random.default_rng(0)
    color = np.repeat(np.repeat(rng.integers(0, 256, (camera.height // 8, camera.width // 8, 3)), 8, 0), 8, 1)
    depth = np.full((camera.height, camera.width), distance, np.float32)
    if seed is not None:
        depth += np.random.default_rng(seed).normal(0, 0.0019 * distance**2, depth.shape).astype(np.float32)
    return Frame(index, float(index), color.astype(np.uint8), depth, camera)


def with_sigma(frame: Frame, low: float = 0.005, high: float = 0.05) -> Frame:
    """The frame with depth whose standard deviations are its own, and differ from pixel to pixel."""
    rng = np.random.default_rng(frame.index)
    return replace(frame, depth_sigma_m=rng.uniform(low, high, frame.depth_m.shape).astype(np.float32))


def dense(occupancy: Occupancy, values: np.ndarray, lo: object, hi: object, fill: object) -> np.ndarray:
    """Per-voxel values (B, 512) as an array over the voxels [lo, hi)."""
    lo, hi = np.asarray(lo), np.asarray(hi)
    out = np.full(hi - lo, fill, values.dtype)
    local = np.arange(512)
    offsets = np.stack((local // 64, local // 8 % 8, local % 8), axis=1)
    index = (occupancy.keys[:, None] * 8 + offsets).reshape(-1, 3) - lo
    inside = ((index >= 0) & (index < hi - lo)).all(axis=1)
    out[tuple(index[inside].T)] = values.reshape(-1)[inside]
    return out


def occupancy_of(
    voxels: object, features: object = None, colors: object = None, free: object = (), origin: object = (0, 0, 0)
) -> Occupancy:
    """An occupancy map with given occupied and free voxels (V, 3) of 0.1 m; features and colors are given in the
    voxels' order and stored in the map's."""
    voxels = np.asarray(voxels, np.int32).reshape(-1, 3)
    free = np.asarray(free, np.int32).reshape(-1, 3)
    every = np.concatenate((voxels, free))
    keys = np.unique(every >> 3, axis=0).astype(np.int32)
    state = np.full((len(keys), 512), 255, np.uint8)
    row_of = {tuple(key): row for row, key in enumerate(keys.tolist())}
    for group, value in ((voxels, 1), (free, 0)):
        for ijk in group:
            i, j, k = ijk & 7
            state[row_of[tuple((ijk >> 3).tolist())], (i * 8 + j) * 8 + k] = value
    probability = np.where(state == 1, 0.9, 0.1).astype(np.float32)
    free_count, hits = (state == 0).astype(np.uint16), (state == 1).astype(np.uint16)
    empty = Occupancy(0.1, np.asarray(origin, float), keys, probability, free_count, hits, state)
    order = [np.flatnonzero((voxels == v).all(axis=1))[0] for v in empty.occupied_voxels()]
    features = np.zeros((len(voxels), 2)) if features is None else np.asarray(features, float)
    colors = np.full((len(voxels), 3), 100) if colors is None else np.asarray(colors)
    return empty.replace(features=features[order].astype(np.float16), colors=colors[order].astype(np.uint8))


def write_standard_ply(
    path: Path, written: Gaussians, spheres: bool = False, harmonics: int = 0, labels: np.ndarray | None = None
) -> Path:
    """Write Gaussians as 3D Gaussian splatting systems do: logits, logarithms, spherical harmonics."""
    n = len(written)
    with np.errstate(invalid="ignore"):
        columns = {
            **{axis: written.means[:, i] for i, axis in enumerate("xyz")},
            **{f"n{axis}": np.zeros(n) for axis in "xyz"},
            **{f"f_dc_{i}": (written.colors[:, i] / 255 - 0.5) / 0.28209479177387814 for i in range(3)},
            **{f"f_rest_{i}": np.zeros(n) for i in range(harmonics)},
            "opacity": np.log(written.opacities / np.maximum(1 - written.opacities, 1e-6)),
            **{f"scale_{i}": np.log(written.scales[:, i]) for i in range(1 if spheres else 3)},
            **{
                f"rot_{i}": 2.0 * written.quats_wxyz[:, i] for i in range(4)
            },  # not of unit length, as optimizers leave it
            **({} if labels is None else {"label": labels}),
        }
    header = "".join(f"property float {name}\n" for name in columns)
    text = f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{header}end_header\n"
    path.write_bytes(text.encode() + np.stack(list(columns.values()), axis=1).astype("<f4").tobytes())
    return path


def cameras(n=30):
    """A walk at 1.5 m that looks around and down by 37 degrees; OpenCV axes."""
    out = []
    for turn in np.linspace(0.3, 2 * np.pi, n):
        forward = np.array((0.8 * np.cos(turn), 0.8 * np.sin(turn), -0.6))
        right = np.array((np.sin(turn), -np.cos(turn), 0.0))
        T = np.eye(4)
        T[:3, :3] = np.stack((right, np.cross(forward, right), forward), axis=1)
        T[:3, 3] = (2 + np.cos(turn), 3 + np.sin(turn), 1.5)
        out.append(T)
    return np.stack(out)
