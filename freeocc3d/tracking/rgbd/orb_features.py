"""ORB features of a frame: detection, back-projection by depth, matching, and poses from matches.

Sources: E. Rublee et al., ORB: an Efficient Alternative to SIFT or SURF, ICCV 2011; M. Fischler, R. Bolles, Random
Sample Consensus, CACM 1981; both as implemented in OpenCV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.compiling import njit
from ...core.types import Frame, Intrinsics
from .alignment_views import AlignmentView
from .dense_residuals import NEAREST_M

COUNT = 800
"""Largest number of features of a frame."""

_PYRAMID_SCALE, _PYRAMID_LEVELS = 1.2, 8
"""Ratio of consecutive image sizes in the search for corners, and number of sizes: OpenCV's defaults."""

_FAST_THRESHOLD = 10
"""Steps of 8 bits by which a corner differs from the pixels around it: half of OpenCV's 20, for dim rooms."""

_NEAREST_DESCRIPTORS = 64
"""Descriptors of one point differ in fewer of their 256 bits; those of different points differ in about 128."""

_ROW_BITS = 16
_ROW = (1 << _ROW_BITS) - 1
_FARTHEST_KEY = 1 << 30
"""A comparison is one number: the different bits above the row, so that the smallest one is the first nearest."""

_ODD_BITS, _PAIRS = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
_NIBBLES, _EVEN_BYTES = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x00FF00FF00FF00FF)

_ALONG_PLANE = 1e-6  # cosine times length: with less, a ray is parallel to the plane
_OFF_CENTER = 0.05
"""Largest difference between a plane's depth on a ray and that at the pixel's center, as a share of the latter. A
plane with more is at grazing incidence."""

_MIN_INLIERS = 12  # smallest number of matches that agree with a pose: a wrong pose has fewer
_CONFIDENCE = 0.999  # that RANSAC has drawn a sample without wrong matches; it stops then
_FARTHEST_PX, _AGREES_PX = 12.0, 4.0
"""Reprojection errors, pixels: beyond the first, a match is wrong and does not count; below the second, it agrees."""

_GEMAN_MCCLURE_PX = 3.0
"""Reprojection error, pixels, at which a match's weight falls to a quarter (``dense_residuals``)."""


@dataclass(frozen=True)
class OrbFeatures:
    """The ORB features of a frame. pixels: (N, 2) float32, in the color image.  descriptors: (N, 32) uint8."""

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]

    def rays(self, camera: Intrinsics) -> NDArray[np.float32]:
        """(N, 2) rays x/z and y/z of the pixels, for a color camera."""
        center = np.array((camera.cx, camera.cy), np.float32)
        return np.asarray((self.pixels - center) / np.array((camera.fx, camera.fy), np.float32), np.float32)


def detect_features(frame: Frame, count: int = COUNT) -> OrbFeatures:
    """Detect the strongest corners of a frame, spread over the image."""
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    orb = cv2.ORB_create(
        nfeatures=count, scaleFactor=_PYRAMID_SCALE, nlevels=_PYRAMID_LEVELS, fastThreshold=_FAST_THRESHOLD
    )
    points, descriptors = orb.detectAndCompute(gray, None)
    if descriptors is None:
        return OrbFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8))
    return OrbFeatures(np.array([p.pt for p in points], np.float32), descriptors)


def lift_rays(rays: NDArray[np.float32], view: AlignmentView) -> NDArray[np.float32]:
    """(N, 3) camera-frame points where the (N, 2) rays meet the fitted planes of the view; 0 without a plane."""
    K = view.intrinsics
    u = np.rint(rays[:, 0] * K.fx + K.cx).astype(int)
    v = np.rint(rays[:, 1] * K.fy + K.cy).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < K.width) & (v < K.height)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    q, n = view.points[v, u], view.normals[v, u]
    directions = np.concatenate((rays, np.ones((len(rays), 1), np.float32)), axis=1)
    along = (n * directions).sum(axis=1)
    known = inside & (q[:, 2] > 0) & (np.abs(along) > _ALONG_PLANE)
    z = np.where(known, (n * q).sum(axis=1) / np.where(known, along, 1.0), 0.0)
    z = np.where(np.abs(z - q[:, 2]) < _OFF_CENTER * q[:, 2], z, 0.0)  # a plane at grazing incidence is unreliable
    return (directions * z[:, None]).astype(np.float32)


def match_binary(a: OrbFeatures, b: OrbFeatures) -> NDArray[np.int64]:
    """(M, 2) rows of a and b with descriptors that are each other's nearest, the first of equally near ones, and
    near."""
    if not len(a.pixels) or not len(b.pixels):
        return np.zeros((0, 2), np.int64)
    return _keep_mutual(*_find_nearest(_words(a), _words(b)))


def match_near(
    a: OrbFeatures, rays_a: NDArray[np.floating], b: OrbFeatures, rays_b: NDArray[np.floating], farthest: float
) -> NDArray[np.int64]:
    """``match_binary`` among those whose rays in one camera, (N, 2) and (M, 2), differ by at most ``farthest`` in each
    direction."""
    order = np.argsort(rays_b[:, 1], kind="stable")
    first = np.searchsorted(rays_b[order, 1], rays_a[:, 1] - farthest, "left")
    last = np.searchsorted(rays_b[order, 1], rays_a[:, 1] + farthest, "right")
    across_a, across_b = (np.ascontiguousarray(x, np.float64) for x in (rays_a[:, 0], rays_b[order, 0]))
    words_b = np.ascontiguousarray(_words(b)[:, order])
    rows = _keep_mutual(*_find_nearest_near(_words(a), across_a, first, last, words_b, across_b, farthest))
    rows[:, 1] = order[rows[:, 1]]
    return rows


def _keep_mutual(nearest_b: NDArray[np.int32], nearest_a: NDArray[np.int32]) -> NDArray[np.int64]:
    """(M, 2) rows that are each other's nearest, and near, from the results of a search."""
    rows = np.flatnonzero(nearest_b < _FARTHEST_KEY)
    rows = rows[nearest_a[nearest_b[rows] & _ROW] & _ROW == rows]
    rows = rows[nearest_b[rows] >> _ROW_BITS < _NEAREST_DESCRIPTORS]
    return np.stack((rows, nearest_b[rows] & _ROW), axis=1).astype(np.int64)


def _words(features: OrbFeatures) -> NDArray[np.uint64]:
    """(4, N): the descriptors as words of 64 bits, so that a compiler can compare several descriptors at once."""
    return np.ascontiguousarray(np.ascontiguousarray(features.descriptors).view(np.uint64).T)


@njit(nogil=True, cache=True)
def _find_nearest(a: NDArray[np.uint64], b: NDArray[np.uint64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """For each descriptor of (4, N) a and of (4, M) b the nearest of the other: the number of different bits, shifted,
    and the row. OpenCV's matcher takes seven times as long."""
    n, m = a.shape[1], b.shape[1]
    nearest_b, nearest_a = np.empty(n, np.int32), np.full(m, _FARTHEST_KEY, np.int32)
    different = np.empty(m, np.int32)
    for i in range(n):
        for j in range(m):
            different[j] = _count_different(a, i, b, j)
        least = np.int32(_FARTHEST_KEY)
        for j in range(m):
            least = min(least, (different[j] << np.int32(_ROW_BITS)) | np.int32(j))
        nearest_b[i] = least
        for j in range(m):
            nearest_a[j] = min(nearest_a[j], (different[j] << np.int32(_ROW_BITS)) | np.int32(i))
    return nearest_b, nearest_a


@njit(nogil=True, cache=True)
def _find_nearest_near(
    a: NDArray[np.uint64],
    across_a: NDArray[np.float64],
    first: NDArray[np.int64],
    last: NDArray[np.int64],
    b: NDArray[np.uint64],
    across_b: NDArray[np.float64],
    farthest: float,
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """``_find_nearest`` among b's rows ``first`` to ``last`` (excluded) of each descriptor of a, whose (M,) coordinates
    across the image are near."""
    n, m = a.shape[1], b.shape[1]
    nearest_b, nearest_a = np.full(n, _FARTHEST_KEY, np.int32), np.full(m, _FARTHEST_KEY, np.int32)
    for i in range(n):
        for j in range(first[i], last[i]):
            if abs(across_a[i] - across_b[j]) > farthest:
                continue
            key = _count_different(a, i, b, j) << np.int32(_ROW_BITS)
            nearest_b[i] = min(nearest_b[i], key | np.int32(j))
            nearest_a[j] = min(nearest_a[j], key | np.int32(i))
    return nearest_b, nearest_a


@njit(nogil=True, cache=True, inline="always")
def _count_different(a, i, b, j):  # type: ignore[no-untyped-def]
    """The number of bits that differ between descriptor i of (4, N) a and j of (4, M) b."""
    bits = np.uint64(0)
    for word in range(4):
        bits += _count_by_byte(a[word, i] ^ b[word, j])  # at most 32 in a byte
    bits = (bits & _EVEN_BYTES) + ((bits >> np.uint64(8)) & _EVEN_BYTES)
    bits += bits >> np.uint64(16)
    bits += bits >> np.uint64(32)
    return np.int32(bits & np.uint64(0x1FF))


@njit(nogil=True, cache=True, inline="always")
def _count_by_byte(word):  # type: ignore[no-untyped-def]
    """The number of set bits of each byte of a word, in that byte. Source: H. Warren, Hacker's Delight, 2002, Sec.
    5-1."""
    word = word - ((word >> np.uint64(1)) & _ODD_BITS)
    word = (word & _PAIRS) + ((word >> np.uint64(2)) & _PAIRS)
    return (word + (word >> np.uint64(4))) & _NIBBLES


def estimate_pose(
    points_s: NDArray[np.float32],
    rays_t: NDArray[np.float32],
    pixel: float,
    threshold_px: float = 3.0,
    iterations: int = 300,
) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """T_target_source (4, 4) from (M, 3) source points and (M, 2) target rays, and the rows of its inliers; None with
    too few inliers. pixel: size of a pixel in ray units, 1 / f.  iterations: RANSAC draws at most."""
    if len(points_s) < _MIN_INLIERS:
        return None
    cv2.setRNGSeed(1)
    good, rotation, translation, inliers = cv2.solvePnPRansac(
        points_s.astype(np.float64), rays_t.astype(np.float64), np.eye(3), None, iterationsCount=iterations,
        reprojectionError=threshold_px * pixel, confidence=_CONFIDENCE, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not good or inliers is None or len(inliers) < _MIN_INLIERS:
        return None
    rows = inliers[:, 0]
    rotation, translation = cv2.solvePnPRefineLM(
        points_s[rows].astype(np.float64), rays_t[rows].astype(np.float64), np.eye(3), None, rotation, translation
    )
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rotation)[0]
    T[:3, 3] = translation[:, 0]
    return T, rows.astype(np.int64)


@njit(nogil=True, cache=True)
def add_reprojection(
    points_s: NDArray[np.float32],
    rays_t: NDArray[np.float32],
    T: NDArray[np.float64],
    focal: float,
    H: NDArray[np.float64],
    g: NDArray[np.float64],
) -> tuple[int, int]:
    """Add the reprojection errors of M matches, in pixels, to normal equations (6, 6), (6,) of T <- exp(xi) T.

    points_s: (M, 3), z = 0 without depth.  rays_t: (M, 2).  focal: pixels per ray unit.
    Returns the number of matches with a depth, and how many of these agree.
    """
    known = agree = 0
    J = np.zeros((2, 6))
    for m in range(len(points_s)):
        if points_s[m, 2] == 0.0:
            continue
        known += 1
        x = T[0, 0] * points_s[m, 0] + T[0, 1] * points_s[m, 1] + T[0, 2] * points_s[m, 2] + T[0, 3]
        y = T[1, 0] * points_s[m, 0] + T[1, 1] * points_s[m, 1] + T[1, 2] * points_s[m, 2] + T[1, 3]
        z = T[2, 0] * points_s[m, 0] + T[2, 1] * points_s[m, 1] + T[2, 2] * points_s[m, 2] + T[2, 3]
        if z < NEAREST_M:
            continue
        eu = focal * (x / z - rays_t[m, 0])
        ev = focal * (y / z - rays_t[m, 1])
        off = math.sqrt(eu * eu + ev * ev)
        if off > _FARTHEST_PX:
            continue
        if off < _AGREES_PX:
            agree += 1
        weight = 1.0 / (1.0 + (off / _GEMAN_MCCLURE_PX) ** 2) ** 2
        f = focal / z
        du0, du2 = f, -f * x / z
        dv1, dv2 = f, -f * y / z
        J[0, 0], J[0, 1], J[0, 2] = y * du2, z * du0 - x * du2, -y * du0
        J[0, 3], J[0, 4], J[0, 5] = du0, 0.0, du2
        J[1, 0], J[1, 1], J[1, 2] = y * dv2 - z * dv1, -x * dv2, x * dv1
        J[1, 3], J[1, 4], J[1, 5] = 0.0, dv1, dv2
        for a in range(6):
            g[a] += weight * (J[0, a] * eu + J[1, a] * ev)
            for b in range(6):
                H[a, b] += weight * (J[0, a] * J[0, b] + J[1, a] * J[1, b])
    return known, agree
