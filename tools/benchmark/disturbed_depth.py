"""Puts into a scan's depth what real sensors and rooms bring: people who walk and leave, panes, mixed edges."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from freeocc3d.core.transforms import back_project, invert, transform
from freeocc3d.core.types import Frame, PosedFrame

Depth = NDArray[np.float32]
Change = Callable[[int, PosedFrame, np.random.Generator], Depth]
"""The depth of the n-th frame, (H, W) meters, with what is put into it."""

_RADIUS_M, _ABOVE_M, _BELOW_M = 0.22, 0.1, 1.5  # of a person's cylinder, and its ends from the camera's height
_AHEAD_M = 1.5  # of a person who walks on the camera's own way
_PANES, _PANE_M = 6, 0.4  # number, and half their edge
_SPECK_PIXELS, _SPECKS = 4, 0.1  # edge of a speck, and their share of a pane
_EDGE, _MIXED = 0.05, 0.5  # relative jump of depth, and the share of its pixels that lie between the two sides
_PIXELS = 400  # wider images are halved


def read_posed(capture: Any, frames: Sequence[int], group: int) -> Iterator[PosedFrame]:
    """Frames at the capture's poses; each group of so many counts as a keyframe with its followers."""
    for n, index in enumerate(frames):
        frame = capture[index]
        camera, depth_m, color = frame.intrinsics, frame.depth_m, frame.color
        if camera.width > _PIXELS:
            width, height = -(-camera.width // 2), -(-camera.height // 2)
            half = [0.5 * value for value in (camera.fx, camera.fy, camera.cx, camera.cy)]
            camera = replace(camera, width=width, height=height, fx=half[0], fy=half[1], cx=half[2], cy=half[3])
            depth_m, color = np.ascontiguousarray(depth_m[::2, ::2]), np.ascontiguousarray(color[::2, ::2])
        frame = Frame(frame.index, frame.timestamp, color, depth_m, camera, None, frame.sensor)
        yield PosedFrame(frame, capture.pose(index), n // group)


def disturb(looks: Sequence[PosedFrame], change: Change | None) -> Iterator[PosedFrame]:
    """The frames with the change, the same each time."""
    for n, look in enumerate(looks):
        if change is None:
            yield look
            continue
        depth_m = change(n, look, np.random.default_rng((0, look.frame.index)))
        yield look._replace(frame=replace(look.frame, depth_m=depth_m.astype(np.float32)))


def walk_ahead(poses: NDArray[np.float64]) -> Change:
    """Somebody walks ahead of the camera, on its own way, in the second quarter of the scan."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    where = np.minimum(np.searchsorted(way, way + _AHEAD_M), len(poses) - 1)
    down = _mean_down(poses)

    def change(n: int, look: PosedFrame, rng: np.random.Generator) -> Depth:
        inside = len(poses) // 4 <= n < len(poses) // 2
        return _add_person(look, poses[where[n], :3, 3], down, rng) if inside else look.frame.depth_m

    return change


def stand_and_leave(poses: NDArray[np.float64]) -> Change:
    """Somebody stands where the camera comes late in the scan, and has left by then."""
    n = len(poses)
    place, down = poses[int(0.8 * n), :3, 3], _mean_down(poses)
    to = place - poses[:, :3, 3]
    ahead = (to * poses[:, :3, 2]).sum(axis=1)
    seen = np.flatnonzero((ahead[: int(0.6 * n)] > 0.8) & (ahead[: int(0.6 * n)] < 5.0))
    there = set(seen[: len(seen) // 2].tolist())

    def change(n: int, look: PosedFrame, rng: np.random.Generator) -> Depth:
        return _add_person(look, place, down, rng) if n in there else look.frame.depth_m

    return change


def make_panes(looks: Sequence[PosedFrame]) -> tuple[Change, NDArray[np.float64]]:
    """Parts of the surface become panes: no depth, and in a few places of each frame some depth behind. Also returns
    the (P, 3) middles of the panes, world, meters."""
    rng = np.random.default_rng(1)
    middles = []
    for n in rng.integers(0, len(looks), _PANES):
        depth = looks[n].frame.depth_m
        h, w = (length // 2 for length in depth.shape)
        middle = depth[h - 10 : h + 10, w - 10 : w + 10]
        if (middle > 0).any():
            straight = np.array([(0, 0, np.median(middle[middle > 0]))])
            middles.append(transform(looks[n].T_world_cam, straight)[0])
    panes = np.array(middles)

    def change(n: int, look: PosedFrame, rng: np.random.Generator) -> Depth:
        depth, shape = look.frame.depth_m.copy(), look.frame.depth_m.shape
        points, blocks = _points(look), [-(-length // _SPECK_PIXELS) for length in shape]
        specks = np.where(rng.random(blocks) < _SPECKS, 1 + rng.random(blocks), 0)
        factor = np.kron(specks, np.ones((_SPECK_PIXELS, _SPECK_PIXELS)))[: shape[0], : shape[1]]
        for middle in panes:
            off = points - transform(invert(look.T_world_cam), middle[None])[0]
            inside = (np.abs(off).max(axis=-1) < _PANE_M) & (look.frame.depth_m > 0)
            depth[inside] = (look.frame.depth_m * factor)[inside]
        return depth

    return change, panes


def mix_edges(n: int, look: PosedFrame, rng: np.random.Generator) -> Depth:
    """Pixels at edges of depth lie anywhere between the two sides."""
    from scipy import ndimage

    depth = look.frame.depth_m
    far, near = ndimage.maximum_filter(depth, 3), ndimage.minimum_filter(np.where(depth > 0, depth, np.inf), 3)
    edge = (depth > 0) & (far > (1 + _EDGE) * near) & (rng.random(depth.shape) < _MIXED)
    near = np.where(edge, near, 0)
    return np.where(edge, near + rng.random(depth.shape) * (far - near), depth)


def _mean_down(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    down: NDArray[np.float64] = poses[:, :3, 1].mean(axis=0)
    return down / np.linalg.norm(down)


def _points(look: PosedFrame) -> NDArray[np.float64]:
    """(H, W, 3) points in the camera's frame, meters."""
    v, u = np.indices(look.frame.depth_m.shape)
    pixels = np.stack((u, v), axis=-1).astype(np.float64)
    return np.asarray(back_project(pixels, look.frame.depth_m, look.frame.intrinsics), np.float64)


def _add_person(
    look: PosedFrame, place: NDArray[np.float64], down: NDArray[np.float64], rng: np.random.Generator
) -> Depth:
    """The depth with a cylinder along ``down`` at a place, the height of a camera on a person, with noise."""
    from freeocc3d.core.depth_sensors import STRUCTURED_LIGHT

    depth, camera = look.frame.depth_m, look.frame.intrinsics
    v, u = np.indices(depth.shape)
    pixels = np.stack((u, v), axis=-1).astype(np.float64)
    rays = back_project(pixels, np.ones(depth.shape), camera) @ look.T_world_cam[:3, :3].T
    off = look.T_world_cam[:3, 3] - place
    across, off_across = rays - (rays @ down)[..., None] * down, off - (off @ down) * down
    a, b, c = (across**2).sum(axis=-1), across @ off_across, off_across @ off_across - _RADIUS_M**2
    root = b * b - a * c
    z = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    height = off @ down + z * (rays @ down)
    hit = (z > 0.3) & (height > -_ABOVE_M) & (height < _BELOW_M) & ((depth == 0) | (z < depth)) & (c > 0)
    return np.where(hit, z + STRUCTURED_LIGHT.compute_sigma(z) * rng.standard_normal(depth.shape), depth)
