"""Prepares a frame for dense alignment: surface points, normals and intensities at about 160 x 120 pixels.

The surface at each pixel is a plane fitted to the inverse depth around it. In inverse depth, planes are linear in the
pixel, and stereo and structured-light noise is nearly uniform. The fit removes most of the sensor noise before the
alignment, and gives the normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.compiling import njit
from ...core.depth_noise import take_sigma
from ...core.types import Frame, Intrinsics
from .dense_residuals import Surface

WIDTH = 160
"""Approximate width of views, pixels."""

_LEVELS = 3
_SMOOTHED = 0.6  # pixels: standard deviation of the blur of the intensities
_WINDOW, _WINDOW_WIDTH = 6, 640
"""Full-size pixels on each side of a center for the plane fit, at this image width."""

_SAME_SURFACE, _ON_PLANE = 0.04, 0.012
"""Largest differences of inverse depths, as shares: from the depth nearest to the center for the first fit, and from
the first plane for the second fit."""

_LEAST_FITTED = 8
"""Smallest number of depths for the plane fit, which has three unknowns."""

_LEAST_SPREAD = 0.02
"""Smallest determinant of the covariance of the fitted pixels, as a share of w^4 / 9, that of a full window. With
less, pixels are in a corner of the window or nearly on a line, and do not determine the plane's tilt."""

_LEAST_FACING = 0.12
"""Smallest cosine between a plane's normal and the ray to it, 83 degrees: at a flatter angle, depth is mostly noise."""

_FARTHER = math.inf  # squared pixels

_LANES = 32
"""Centers to which planes are fitted at once: with a constant number, a compiler adds several sums by one instruction,
and keeps them in the first cache."""


@dataclass(frozen=True)
class AlignmentView:
    """A frame, prepared for alignment.

    intrinsics: of the (h, w) images.  points: (h, w, 3) float32, camera frame, meters; 0 without a surface.
    normals: (h, w, 3) float32 unit.  sigma_m: (h, w) float32 standard deviations of the depth, meters, or the sensor's
    coefficients (``depth_noise.take_sigma``).  gray: intensities 0…1, float32, at full, half and quarter size.
    """

    intrinsics: Intrinsics
    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    gray: tuple[NDArray[np.float32], ...]

    @property
    def camera(self) -> NDArray[np.float64]:
        """fx, fy, cx, cy."""
        K = self.intrinsics
        return np.array((K.fx, K.fy, K.cx, K.cy))

    @property
    def levels(self) -> tuple[Surface, ...]:
        """The surface with the intensities at each size, the largest first."""
        return tuple(Surface(self.points, self.normals, self.sigma_m, gray) for gray in self.gray)

    @property
    def covered(self) -> float:
        """Share of the pixels that have a surface."""
        return float((self.points[..., 2] > 0).mean())


def prepare_alignment_view(frame: Frame) -> AlignmentView:
    """Prepare a frame for alignment."""
    camera = frame.intrinsics
    step = max(1, round(camera.width / WIDTH))
    w, h = camera.width // step, camera.height // step
    small = Intrinsics(
        w, h, camera.fx / step, camera.fy / step, (camera.cx + 0.5) / step - 0.5, (camera.cy + 0.5) / step - 0.5
    )
    window = max(2, round(_WINDOW * camera.width / _WINDOW_WIDTH))
    points, normals = fit_planes(frame.depth_m, step, window, camera.fx, camera.fy, camera.cx, camera.cy)
    gray = cv2.cvtColor(frame.color[: h * step, : w * step], cv2.COLOR_RGB2GRAY)
    gray = cv2.resize(gray, (w, h), interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    pyramid = [cv2.GaussianBlur(gray, (3, 3), _SMOOTHED)]
    for _ in range(_LEVELS - 1):
        pyramid.append(cv2.pyrDown(pyramid[-1]))
    return AlignmentView(small, points, normals, _average_sigma(frame, step), tuple(pyramid))


def _average_sigma(frame: Frame, step: int) -> NDArray[np.float32]:
    """(h, w) mean stated sigma, meters, of the pixels with a depth in each square of ``step`` pixels; 0 without any. If
    none is stated, the sensor's coefficients."""
    if frame.depth_sigma_m is None:
        return take_sigma(frame)
    h, w = frame.depth_m.shape[0] // step, frame.depth_m.shape[1] // step
    known = (frame.depth_m > 0)[: h * step, : w * step].reshape(h, step, w, step)
    sigma = frame.depth_sigma_m[: h * step, : w * step].reshape(h, step, w, step)
    total = np.where(known, sigma, np.float32(0)).sum(axis=(1, 3))
    return np.asarray(total / np.maximum(known.sum(axis=(1, 3)), 1), np.float32)


@njit(nogil=True, cache=True, error_model="numpy")
def fit_planes(
    depth_m: NDArray[np.float32], step: int, window: int, fx: float, fy: float, cx: float, cy: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points and normals (h, w, 3) of planes 1/z = a + b (u - u0) + c (v - v0), fitted around every ``step``-th pixel
    center (u0, v0) to the depths of one surface within ``window`` pixels; 0 with too few depths."""
    h, w = depth_m.shape[0] // step, depth_m.shape[1] // step
    points = np.zeros((h, w, 3), np.float32)
    normals = np.zeros((h, w, 3), np.float32)
    inverse_m, near = _invert_depth(depth_m, step, window)
    plane = np.empty((4, _LANES), np.float32)
    for i in range(h):
        y = (i * step + 0.5 * (step - 1) - cy) / fy
        for first in range(0, w, _LANES):
            _fit_row(inverse_m, near, i, first, step, window, plane)
            for k in range(min(_LANES, w - first)):
                j = first + k
                a = near[i, j] + plane[0, k]
                if plane[3, k] <= 0 or a <= 0:
                    continue
                x = (j * step + 0.5 * (step - 1) - cx) / fx
                nx, ny = plane[1, k] * fx, plane[2, k] * fy
                nz = a - nx * x - ny * y  # n . X = 1
                length = math.sqrt(nx * nx + ny * ny + nz * nz)
                if a < _LEAST_FACING * length * math.sqrt(x * x + y * y + 1.0):
                    continue
                z = 1.0 / a
                points[i, j, 0], points[i, j, 1], points[i, j, 2] = x * z, y * z, z
                normals[i, j, 0], normals[i, j, 1], normals[i, j, 2] = nx / length, ny / length, nz / length
    return points, normals


@njit(nogil=True, cache=True, inline="always")
def _window_pixels(step: int, window: int) -> tuple[int, int, int]:
    """The first pixel of a center's window, the one after the last, both from the first pixel of the center's square,
    and the step between those that are fitted."""
    middle = (step - 1) // 2
    return middle - window + 1, middle + window + 1, 2 if window >= 4 else 1


@njit(nogil=True, cache=True, error_model="numpy")
def _invert_depth(
    depth_m: NDArray[np.float32], step: int, window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(H, step, w + margins) inverse depths, 0 without a depth: that of pixel (v, u) at [v, u % step, u // step +
    margin], so that what neighboring centers compare lies side by side. (h, w + lanes) those nearest to the centers."""
    H, W = depth_m.shape
    h, w = H // step, W // step
    first, _, stride = _window_pixels(step, window)
    margin = window // step + 1
    inverse_m = np.zeros((H, step, w + _LANES + 2 * margin), np.float32)
    every = stride if step % stride == 0 else 1  # windows hold no other pixels
    for v in range(first % every, H, every):
        for phase in range(first % every, step, every):
            for j in range(min(w + margin, (W - phase + step - 1) // step)):
                z = depth_m[v, j * step + phase]
                if z > 0:
                    inverse_m[v, phase, j + margin] = 1.0 / z
    near = np.zeros((h, w + _LANES), np.float32)
    middle, center = (step - 1) // 2, 0.5 * (step - 1)
    for i in range(h):
        for j in range(w):
            z = depth_m[i * step + middle, j * step + middle]
            if not z > 0:
                best = _FARTHER
                for v in range(step):
                    for u in range(step):
                        d = (u - center) ** 2 + (v - center) ** 2
                        if depth_m[i * step + v, j * step + u] > 0 and d < best:
                            best = d
                            z = depth_m[i * step + v, j * step + u]
            if z > 0:
                near[i, j] = 1.0 / z
    return inverse_m, near


@njit(nogil=True, cache=True, error_model="numpy")
def _fit_row(
    inverse_m: NDArray[np.float32],
    near: NDArray[np.float32],
    i: int,
    first: int,
    step: int,
    window: int,
    plane: NDArray[np.float32],
) -> None:
    """Fit the planes of ``_LANES`` centers of row ``i`` at once: the innermost loops are over centers.

    plane: receives a - near, b, c and the largest difference from the plane, which is negative where there is none.
    """
    begin, end, stride = _window_pixels(step, window)
    center, margin, height = 0.5 * (step - 1), window // step + 1, len(inverse_m)
    nearest = np.empty(_LANES, np.float32)
    row, total = np.empty((6, _LANES), np.float32), np.empty((9, _LANES), np.float32)
    least = np.float32(_LEAST_SPREAD * window**4 / 9)
    for k in range(_LANES):
        nearest[k] = near[i, first + k]
        plane[0, k] = plane[1, k] = plane[2, k] = np.float32(0)
        plane[3, k] = np.float32(_SAME_SURFACE) * nearest[k]
    for _ in range(2):
        for s in range(9):
            for k in range(_LANES):
                total[s, k] = np.float32(0)
        for v in range(begin, end, stride):
            if not 0 <= i * step + v < height:
                continue
            dv = np.float32(v - center)
            for k in range(_LANES):
                row[0, k] = row[1, k] = row[2, k] = row[3, k] = row[4, k] = np.float32(0)
                row[5, k] = nearest[k] + plane[0, k] + plane[2, k] * dv
            for u in range(begin, end, stride):
                du = np.float32(u - center)
                values = inverse_m[i * step + v, u % step, first + u // step + margin :]
                for k in range(_LANES):
                    held = (values[k] > 0) & (abs(values[k] - row[5, k] - plane[1, k] * du) <= plane[3, k])
                    one = np.float32(1) if held else np.float32(0)
                    above = values[k] - nearest[k] if held else np.float32(0)
                    row[0, k] += one
                    row[1, k] += one * du
                    row[2, k] += one * (du * du)
                    row[3, k] += above
                    row[4, k] += above * du
            for k in range(_LANES):
                total[0, k] += row[0, k]
                total[1, k] += row[1, k]
                total[2, k] += row[0, k] * dv
                total[3, k] += row[2, k]
                total[4, k] += row[0, k] * (dv * dv)
                total[5, k] += row[1, k] * dv
                total[6, k] += row[3, k]
                total[7, k] += row[4, k]
                total[8, k] += row[3, k] * dv
        for k in range(_LANES):
            n = total[0, k]
            mu, mv, mw = total[1, k] / n, total[2, k] / n, total[6, k] / n
            uu, vv, uv = total[3, k] / n - mu * mu, total[4, k] / n - mv * mv, total[5, k] / n - mu * mv
            wu, wv = total[7, k] / n - mw * mu, total[8, k] / n - mw * mv
            det = uu * vv - uv * uv
            good = (n >= _LEAST_FITTED) & (det >= least) & (plane[3, k] > 0)
            plane[1, k] = (wu * vv - wv * uv) / det
            plane[2, k] = (wv * uu - wu * uv) / det
            plane[0, k] = mw - plane[1, k] * mu - plane[2, k] * mv
            plane[3, k] = np.float32(_ON_PLANE) * nearest[k] if good else np.float32(-1)
