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
    H, W = depth_m.shape
    h, w = H // step, W // step
    points = np.zeros((h, w, 3), np.float32)
    normals = np.zeros((h, w, 3), np.float32)
    stride = 2 if window >= 4 else 1
    inverse_m = np.zeros((H, W))  # 0 without a depth; each is used in many windows
    for v in range(H):
        for u in range(W):
            if depth_m[v, u] > 0:
                inverse_m[v, u] = 1.0 / depth_m[v, u]
    for i in range(h):
        v0 = i * step + 0.5 * (step - 1)
        for j in range(w):
            u0 = j * step + 0.5 * (step - 1)
            near = 0.0
            best = _FARTHER
            for v in range(i * step, min(i * step + step, H)):
                for u in range(j * step, min(j * step + step, W)):
                    d = (u - u0) ** 2 + (v - v0) ** 2
                    if inverse_m[v, u] > 0 and d < best:
                        best = d
                        near = inverse_m[v, u]
            if near == 0.0:
                continue
            a, b, c = near, 0.0, 0.0
            good = False
            for sweep in range(2):
                allowed = _SAME_SURFACE * near if sweep == 0 else _ON_PLANE * near
                n = suu = svv = suv = su = sv = 0.0
                sw = swu = swv = 0.0
                for v in range(max(0, int(v0) - window + 1), min(H, int(v0) + window + 1), stride):
                    dv = v - v0
                    for u in range(max(0, int(u0) - window + 1), min(W, int(u0) + window + 1), stride):
                        inverse = inverse_m[v, u]
                        if inverse == 0:
                            continue
                        du = u - u0
                        if abs(inverse - (a + b * du + c * dv)) > allowed:
                            continue
                        n += 1.0
                        su += du
                        sv += dv
                        suu += du * du
                        svv += dv * dv
                        suv += du * dv
                        sw += inverse
                        swu += inverse * du
                        swv += inverse * dv
                if n < _LEAST_FITTED:
                    good = False
                    break
                mu, mv, mw = su / n, sv / n, sw / n
                uu, vv, uv = suu / n - mu * mu, svv / n - mv * mv, suv / n - mu * mv
                wu, wv = swu / n - mw * mu, swv / n - mw * mv
                det = uu * vv - uv * uv
                if det < _LEAST_SPREAD * window**4 / 9:
                    good = False
                    break
                b = (wu * vv - wv * uv) / det
                c = (wv * uu - wu * uv) / det
                a = mw - b * mu - c * mv
                good = a > 0
            if not good:
                continue
            z = 1.0 / a
            x, y = (u0 - cx) / fx * z, (v0 - cy) / fy * z
            nx, ny, nz = b * fx, c * fy, a + b * (cx - u0) + c * (cy - v0)
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            grazing = 1.0 / (length * math.sqrt(x * x + y * y + z * z))  # n . X = 1
            if grazing < _LEAST_FACING:
                continue
            points[i, j, 0], points[i, j, 1], points[i, j, 2] = x, y, z
            normals[i, j, 0], normals[i, j, 1], normals[i, j, 2] = nx / length, ny / length, nz / length
    return points, normals
