"""How well the depth images of a scan agree with each other at their poses, without any truth.

The points p of a source view are moved into a target view by their poses, p' = T p. With d the target's depth where p'
projects, they differ by

    r = p'_z - d(pi(p')),                                                                                           (1)

lengths along the target's optical axis. The back of a surface is not compared with its front. A point far behind the
target's surface is hidden by it and not compared; one far in front of it is seen through. Neighbors on the path share
most errors of poses and of the sensor, so that their residuals tell the noise. Pairs at revisits, where the camera
looked elsewhere in between, add the errors of poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.depth_noise import compute_sigma_image
from ..core.sampling import spread_evenly
from ..core.threads import count_threads
from ..core.transforms import back_project, invert, project, transform
from ..core.types import Frame, Intrinsics
from .rgbd.dense_residuals import GEMAN_MCCLURE

WIDTH = 160
"""Approximate columns of a compared view, pixels. Depth is picked, so that few pixels tell as much; and a thousand
views are small."""

GATE = 0.1
"""Share of a depth beyond which two depths are of two surfaces; the same as for overlap."""

LEAST_OVERLAP, ELSEWHERE = 0.25, 0.1
"""Shares of a view: two views are compared if they have at least the first in common, and the camera looked elsewhere
in between if some view there shares less than the second with one of the two."""

MOST_PAIRS = 200
"""Pairs of each kind that are compared, evenly chosen: enough for a median, in a fraction of a second."""

_COLUMNS, _OVERLAP_COLUMNS = 80, 12  # sampled points along a row, of a pair and for overlaps
_MOST_VIEWS = 256  # among which revisits are looked for, evenly chosen
_LEAST_POINTS = 100  # of a compared pair
_ASIDE = 2  # pixels from a point to those that give its normal: far enough that noise does not turn it around
_SMOOTH = 0.1  # largest relative difference of their depths
_SAME_SURFACE = 0.04  # largest relative difference of the four depths around a point, which lie on one surface
_DISTORTION_COLUMNS, _REWEIGHTED = 32, 6  # sampled points along a row, and sweeps, for the sensor's distortion
_LEAST_FACING = 0.3  # cosine between a normal and a ray, 73 degrees: beyond it, depth changes too fast
_FLAT = 1e-3  # least variance of gray values that tells a gain


class SurfacePoints(NamedTuple):
    """P measured points in their camera's frame. pixels: (P, 2) rows and columns.  points: (P, 3) meters.  normals:
    (P, 3) toward the camera, of any length."""

    pixels: NDArray[np.int64]
    points: NDArray[np.float64]
    normals: NDArray[np.float64]

    def facing(self, T_other_cam: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(P,) whether the surface shows the side that was measured to another camera, and not its back."""
        return np.asarray(((invert(T_other_cam)[:3, 3] - self.points) * self.normals).sum(axis=1) > 0)


@dataclass(frozen=True)
class ComparedView:
    """A small view. depth_m: (H, W) float32 meters, 0 = none.  sigma_m: (H, W) its standard deviation.  gray: (H, W)
    uint8.  camera: of all."""

    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    gray: NDArray[np.uint8]
    camera: Intrinsics

    def sample(self, columns: int) -> SurfacePoints:
        """An even sample of the pixels on smooth surfaces, about ``columns`` along a row."""
        height, width = self.depth_m.shape
        step = max(1, width // columns)
        first = max(step // 2, _ASIDE)
        v, u = (axis.ravel() for axis in np.mgrid[first : height - _ASIDE : step, first : width - _ASIDE : step])
        depth = self.depth_m[v, u]
        ends = [(v, u + _ASIDE), (v, u - _ASIDE), (v + _ASIDE, u), (v - _ASIDE, u)]
        beside = np.stack([self.depth_m[end] for end in ends])
        smooth = (depth > 0) & (np.abs(beside - depth) <= _SMOOTH * depth).all(axis=0)
        right, left, down, up = (
            self._back_project(at_v[smooth], at_u[smooth], z[smooth])
            for (at_v, at_u), z in zip(ends, beside, strict=True)
        )
        v, u = v[smooth], u[smooth]
        toward_camera = np.cross(down - up, right - left)
        return SurfacePoints(np.stack((v, u), axis=1), self._back_project(v, u, depth[smooth]), toward_camera)

    def _back_project(
        self, v: NDArray[np.int64], u: NDArray[np.int64], depth_m: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        return back_project(np.stack((u, v), axis=1).astype(np.float64), depth_m.astype(np.float64), self.camera)


def prepare_compared_view(frame: Frame) -> ComparedView:
    """Reduce a frame to about ``WIDTH`` columns. Depth is picked, not averaged; gray values are averaged around the
    same pixels."""
    camera, step = frame.intrinsics, max(1, frame.intrinsics.width // WIDTH)
    first = step // 2
    gray = cv2.blur(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), (step | 1, step | 1))[first::step, first::step]
    depth_m, sigma_m = (image[first::step, first::step].copy() for image in (frame.depth_m, compute_sigma_image(frame)))
    height, width = depth_m.shape
    small = Intrinsics(
        width, height, camera.fx / step, camera.fy / step, (camera.cx - first) / step, (camera.cy - first) / step
    )
    return ComparedView(depth_m, sigma_m, np.asarray(gray, np.uint8), small)


def prepare_compared_views(frames: Sequence[Frame]) -> list[ComparedView]:
    """``prepare_compared_view`` for frames that are decoded when they are taken, by all threads."""
    with ThreadPoolExecutor(count_threads()) as pool:
        return list(pool.map(lambda row: prepare_compared_view(frames[row]), range(len(frames))))


class Compared(NamedTuple):
    """The P compared points of a pair. pixels: (P, 2) rows and columns in the source.  points, normals: (P, 3) in the
    source's camera frame.  off_m: (P,) residuals of eq. 1.  sigma_m: (P,) their standard deviation by noise alone.
    gray: (P,) the target's gray value minus the source's, after gain and offset.  seen_through: share of the points in
    view that the target sees through."""

    pixels: NDArray[np.int64]
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    off_m: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    gray: NDArray[np.float64]
    seen_through: float


@dataclass(frozen=True)
class PairAgreement:
    """A compared pair. source, target: rows of the views.  off_m: median of |r|, meters.  sigmas: the same in standard
    deviations of the noise, which grows with the distance.  gray: median difference of gray values 0…255.
    seen_through: share of the source's points in view that the target sees through."""

    source: int
    target: int
    off_m: float
    sigmas: float
    gray: float
    seen_through: float


@dataclass(frozen=True)
class Agreement:
    """Compared pairs: neighbors on the path, and revisits."""

    steps: list[PairAgreement]
    revisits: list[PairAgreement]


def measure_agreement(views: Sequence[ComparedView], T_world_cam: NDArray[np.float64]) -> Agreement:
    """Compare K views at their (K, 4, 4) poses, in the order of the path."""
    steps = [(row + 1, row) for row in spread_evenly(len(views) - 1, MOST_PAIRS)]
    revisits = find_revisits(views, T_world_cam)
    chosen = [revisits[row] for row in spread_evenly(len(revisits), MOST_PAIRS)]
    return Agreement(*([made for pair in pairs if (made := _agreement(views, T_world_cam, *pair))]
                       for pairs in (steps, chosen)))  # fmt: skip


def find_revisits(views: Sequence[ComparedView], T_world_cam: NDArray[np.float64]) -> list[tuple[int, int]]:
    """(later, earlier) rows of views that show the same place, with a view of another place between them."""
    rows = np.array(spread_evenly(len(views), _MOST_VIEWS), np.int64)
    if len(rows) < 3:
        return []
    shared = measure_overlaps([views[row] for row in rows], T_world_cam[rows])
    apart = np.cumsum(shared < ELSEWHERE, axis=1)  # [a, k]: views 0 … k that share little with a
    later, earlier = np.nonzero(np.tril(shared >= LEAST_OVERLAP, -2))
    between: NDArray[np.int64] = (
        apart[later, later - 1] - apart[later, earlier] + apart[earlier, later - 1] - apart[earlier, earlier]
    )
    return [(int(rows[a]), int(rows[b])) for a, b in zip(later[between > 0], earlier[between > 0], strict=True)]


def measure_overlaps(views: Sequence[ComparedView], T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, K) share that the views have in common, symmetric: the smaller of both directions. A point is shared if the
    same side of its surface lies in the other view, and the depth there is missing or of the same surface."""
    samples = [view.sample(_OVERLAP_COLUMNS) for view in views]
    counts = np.array([len(sample.points) for sample in samples])
    points = np.concatenate([transform(T, own.points) for T, own in zip(T_world_cam, samples, strict=True)])
    normals = np.concatenate([own.normals @ T[:3, :3].T for T, own in zip(T_world_cam, samples, strict=True)])
    world = SurfacePoints(np.zeros((0, 2), np.int64), points, normals)
    owner = np.repeat(np.arange(len(views)), counts)
    shared = np.zeros((len(views), len(views)))
    for row, (view, T) in enumerate(zip(views, T_world_cam, strict=True)):
        pixels, z, inside = _project(transform(invert(T), points), view)
        inside &= world.facing(invert(T))
        column, line = np.rint(pixels[inside]).astype(np.int64).T
        depth = view.depth_m[line, column]
        seen = (depth == 0) | (np.abs(depth - z[inside]) < GATE * z[inside])
        shared[:, row] = np.bincount(owner[inside][seen], minlength=len(views)) / np.maximum(counts, 1)
    return np.minimum(shared, shared.T)


def compare_views(
    source: ComparedView, target: ComparedView, T_target_source: NDArray[np.float64], columns: int = _COLUMNS
) -> Compared:
    """Compare a sample of the source's points, ``columns`` along a row, with the target (eq. 1)."""
    at, points, normals = sample = source.sample(columns)
    pixels, z, inside = _project(transform(T_target_source, points), target)
    inside &= sample.facing(T_target_source)
    u, v = pixels[inside].T
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    weights = _bilinear(u - left, v - top)
    around = _around(target.depth_m, top, left)
    near, far = around.min(axis=0), around.max(axis=0)
    flat = (near > 0) & (far <= (1 + _SAME_SURFACE) * near)
    rows = np.flatnonzero(inside)[flat]
    depth = 1 / (weights[:, flat] / around[:, flat]).sum(axis=0)  # planes are linear in inverse depth
    off = z[rows] - depth
    same = np.abs(off) <= GATE * depth
    known = rows[same]
    gray_t = (weights * _around(target.gray, top, left))[:, flat].sum(axis=0)[same]
    gray = _without_exposure(source.gray[tuple(at[known].T)].astype(np.float64), gray_t)
    through = float((off < -GATE * depth).mean()) if len(off) else 0.0
    sigma = np.hypot(source.sigma_m[tuple(at[known].T)], target.sigma_m[top, left][flat][same])
    return Compared(at[known], points[known], normals[known], off[same], sigma, gray, through)


def measure_distortion(
    views: Sequence[ComparedView], T_world_cam: NDArray[np.float64], pairs: Sequence[PairAgreement]
) -> NDArray[np.float64]:
    """(3,) coefficients c of a smooth error of the sensor's depth, e = z^2 (c_0 x + c_1 y + c_2 (x^2 + y^2)) meters,
    that explains the residuals of pairs best; x, y are pixels from the principal point over half the image's width. It
    is an error of the disparity that is linear and radial in the image. Poses that were fitted to the same depth have
    taken up a part of it.

    By iteratively reweighted least squares: an error e_s of the source's depth moves its point along its ray, and e_t
    moves the target's surface, so that (1) changes by e_s (n^T R ray_s) / (n^T ray_t) - e_t.
    """
    rows, off, sigma = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0)]
    for pair in pairs:
        source, target = views[pair.source], views[pair.target]
        T = invert(T_world_cam[pair.target]) @ T_world_cam[pair.source]
        found = compare_views(source, target, T, _DISTORTION_COLUMNS)
        moved, normals = transform(T, found.points), found.normals @ T[:3, :3].T
        ray_s, ray_t = found.points / found.points[:, 2:] @ T[:3, :3].T, moved / moved[:, 2:]
        toward = (normals * ray_t).sum(axis=1)
        seen = np.abs(toward) > _LEAST_FACING * np.linalg.norm(normals, axis=1) * np.linalg.norm(ray_t, axis=1)
        gain = (normals * ray_s).sum(axis=1)[seen] / toward[seen]
        of_source = _distortion_basis(found.points[seen], source.camera)
        rows.append(gain[:, None] * of_source - _distortion_basis(moved[seen], target.camera))
        off.append(found.off_m[seen])
        sigma.append(found.sigma_m[seen])
    basis, wanted, scale = np.concatenate(rows), np.concatenate(off), np.concatenate(sigma)
    c: NDArray[np.float64] = np.zeros(3)
    for _ in range(_REWEIGHTED):
        share = (wanted - basis @ c) / (GEMAN_MCCLURE * scale)
        weighted = basis / ((1 + share**2) * scale)[:, None] ** 2
        c = np.asarray(np.linalg.lstsq(weighted.T @ basis, weighted.T @ wanted, rcond=None)[0])
    return c


def distortion_range(coefficients: NDArray[np.float64], camera: Intrinsics, depth_m: float) -> float:
    """Half the difference of the largest and the smallest error in the image at a depth, meters."""
    v, u = np.meshgrid(np.linspace(0, camera.height - 1, 9), np.linspace(0, camera.width - 1, 9))
    pixels = np.stack((u.ravel(), v.ravel()), axis=1)
    points = back_project(pixels, np.full(len(pixels), depth_m), camera)
    return float(np.ptp(_distortion_basis(points, camera) @ coefficients) / 2)


def _distortion_basis(points: NDArray[np.float64], camera: Intrinsics) -> NDArray[np.float64]:
    """(P, 3) derivative of the error by its coefficients."""
    x, y = (2 * f / camera.width * points[:, axis] / points[:, 2] for axis, f in enumerate((camera.fx, camera.fy)))
    return points[:, 2:] ** 2 * np.stack((x, y, x**2 + y**2), axis=1)


def _agreement(
    views: Sequence[ComparedView], T_world_cam: NDArray[np.float64], source: int, target: int
) -> PairAgreement | None:
    """None if too little can be compared."""
    found = compare_views(views[source], views[target], invert(T_world_cam[target]) @ T_world_cam[source])
    if len(found.off_m) < _LEAST_POINTS:
        return None
    off = np.abs(found.off_m)
    sigmas, gray = float(np.median(off / found.sigma_m)), float(np.median(np.abs(found.gray)))
    return PairAgreement(source, target, float(np.median(off)), sigmas, gray, found.seen_through)


def _project(
    points: NDArray[np.float64], view: ComparedView
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """(P, 2) pixels and (P,) depths of points in the view's frame, and whether they lie between pixel centers."""
    pixels, z = project(points, view.camera)
    with np.errstate(invalid="ignore"):  # points behind the camera project to NaN, which counts as outside
        inside = (pixels >= 0).all(axis=1) & (pixels < (view.camera.width - 1, view.camera.height - 1)).all(axis=1)
    return pixels, z, np.asarray(inside, bool)


def _around(image: NDArray[np.generic], top: NDArray[np.int64], left: NDArray[np.int64]) -> NDArray[np.float64]:
    """(4, P) values of the pixels around points."""
    rows, columns = np.stack((top, top, top + 1, top + 1)), np.stack((left, left + 1, left, left + 1))
    return image[rows, columns].astype(np.float64)


def _bilinear(du: NDArray[np.float64], dv: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, P) weights of the same pixels."""
    return np.stack(((1 - dv) * (1 - du), (1 - dv) * du, dv * (1 - du), dv * du))


def _without_exposure(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Target minus source, after the gain and offset that fit best."""
    if not len(source):
        return source
    centered, wanted = source - source.mean(), target - target.mean()
    gain = float((centered * wanted).mean() / max((centered**2).mean(), _FLAT))
    return wanted - gain * centered
