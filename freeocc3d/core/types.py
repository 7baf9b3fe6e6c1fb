"""The data that layers exchange: arrays with their shapes, units and frames. The types only hold and read them.

Conventions: camera-to-world poses, OpenCV camera axes (x right, y down, z forward), meters, seconds; ``T_a_b`` maps
coordinates of frame b to frame a; voxel (i, j, k) covers ``origin + [i, i+1) * voxel_size``.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .depth_sensors import STRUCTURED_LIGHT, DepthSensor

BLOCK = 8
"""Voxels along each edge of a voxel block."""

FREE, OCCUPIED, UNKNOWN = 0, 1, 255
"""The states of a voxel."""


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera without distortion: pixel = (fx x/z + cx, fy y/z + cy); integer pixels are pixel centers."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) calibration matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> Intrinsics:
        """The camera of the same image, resampled to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(
            width, height, self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        )


@dataclass(frozen=True)
class Frame:
    """One decoded frame of a capture. It never holds poses or class images: a layer that may read them asks the capture
    for them by name, so a pose-free run cannot see the truth by accident.

    index: position in the capture, 0 … len(capture)-1.
    timestamp: seconds; equal to ``index`` if the format has no times.
    color: (H, W, 3) uint8 RGB.
    depth_m: (H, W) float32 meters, registered to ``color``'s pixels; 0 = no measurement.
    intrinsics: of both ``color`` and ``depth_m``, which have the same size.
    depth_sigma_m: (H, W) float32 standard deviation of ``depth_m``, meters, positive where ``depth_m`` is; None = the
    one of ``sensor`` applies (``depth_noise.look_up_sigma``).
    """

    index: int
    timestamp: float
    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    intrinsics: Intrinsics
    depth_sigma_m: NDArray[np.float32] | None = None
    sensor: DepthSensor = STRUCTURED_LIGHT

    def scaled(self, factor: float) -> Frame:
        """The frame with every length multiplied by ``factor``."""
        sigma = self.depth_sigma_m
        return replace(
            self,
            depth_m=self.depth_m * np.float32(factor),
            depth_sigma_m=None if sigma is None else sigma * np.float32(factor),
        )


@dataclass(frozen=True)
class Trajectory:
    """Camera poses of a capture's frames, row n = frame n of the capture.

    timestamps: (N,) float64 seconds.
    T_world_cam: (N, 4, 4) float64; all NaN where the frame has no pose.
    keyframes: (K,) int32, indices of the keyframes, ascending.
    status: (N,) of "keyframe", "tracked", "relocalised" (lost, then found again), "interpolated" (between neighbors),
    "apart" (in a submap that is not connected to the mapped one), "lost", "broken" (not decodable), "unused" (not
    selected). Frames with the last four have no pose.
    confidence: (N,) float32 in 0…1.
    """

    timestamps: NDArray[np.float64]
    T_world_cam: NDArray[np.float64]
    keyframes: NDArray[np.int32]
    status: NDArray[np.str_]
    confidence: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """(N,) whether each frame has a pose."""
        return np.asarray(np.isfinite(self.T_world_cam).all(axis=(1, 2)))

    @property
    def T_world_keyframe(self) -> NDArray[np.float64]:
        """(K, 4, 4) poses of the keyframes."""
        return self.T_world_cam[self.keyframes]

    def only_keyframes(self, keyframes: NDArray[np.int32]) -> Trajectory:
        """The same poses with only the given keyframes."""
        return replace(self, keyframes=keyframes)


class PosedFrame(NamedTuple):
    """A frame and its pose.

    T_world_cam: (4, 4) float64.  keyframe: row of ``Trajectory.keyframes`` of the keyframe that its pose is relative
    to; its own row if it is a keyframe.
    """

    frame: Frame
    T_world_cam: NDArray[np.float64]
    keyframe: int


@dataclass(frozen=True)
class Submap:
    """A connected part of the camera path. A submap that is not connected to others has its own world frame.

    frames: (F,) int32, indices of its frames, ascending.  T_submap_cam: (F, 4, 4) their poses.
    keyframes: (K,) int32, the frames that are keyframes.
    closures: (C, 2) int32, loop closures: pairs of keyframes, as frame indices, that show the same place.
    held: (C,) whether the optimized path agrees with the closure; if not, the closure is wrong.
    """

    frames: NDArray[np.int32]
    T_submap_cam: NDArray[np.float64]
    keyframes: NDArray[np.int32]
    closures: NDArray[np.int32]
    held: NDArray[np.bool_]


@dataclass(frozen=True)
class Gaussians:
    """N anchored Gaussians G = (mu, s, r, o, c). A mean is never a free parameter: it is ``anchor_cam`` transformed by
    the pose of its keyframe (paper, "Geometrically Anchored Gaussian Updates").

    means: (N, 3) float32, world, meters.
    scales: (N, 3) float32, standard deviations along the principal axes, meters.
    quats_wxyz: (N, 4) float32, unit, principal axes to world.
    opacities: (N,) float32 in 0…1.
    colors: (N, 3) uint8 RGB.
    anchor_keyframe: (N,) int32, row of ``Trajectory.keyframes``.
    anchor_cam: (N, 3) float32, the anchor in that keyframe's camera frame, meters; its projection gives the anchor's
        pixel and depth.
    """

    means: NDArray[np.float32]
    scales: NDArray[np.float32]
    quats_wxyz: NDArray[np.float32]
    opacities: NDArray[np.float32]
    colors: NDArray[np.uint8]
    anchor_keyframe: NDArray[np.int32]
    anchor_cam: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, rows: NDArray[np.generic] | slice) -> Gaussians:
        return Gaussians(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @classmethod
    def concatenated(cls, parts: Sequence[Gaussians]) -> Gaussians:
        """Concatenate one or more sets, in order."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


@dataclass(frozen=True)
class Occupancy:
    """Occupancy in a voxel grid of sparse blocks of 8 x 8 x 8 voxels. Space without a block is unknown.

    voxel_size: edge of a level-0 voxel, meters.  origin: (3,) float64 world position of the lower corner of voxel
    (0, 0, 0).
    keys: (B, 3) int32, block indices; block b covers voxels ``8 * keys[b] + (0…7)`` of its level. Keys are unique
    within a level and in no particular order.  levels: (B,) uint8, how often the voxel edge of a block is halved; all
    0, the default, in a map with one voxel size. In a map with several sizes no two blocks overlap.
    Per voxel, (B, 512), with local index (i * 8 + j) * 8 + k:
    probability: float32 alpha(x) at the voxel's center (paper, Gaussian-to-Occupancy Projection), in 0…1.
    free: uint16 number of depth images that see through the voxel.  hits: uint16 number of those that end in it.
    state: uint8 FREE, OCCUPIED or UNKNOWN.
    Per occupied voxel, (V, …), in the order of ``occupied_voxels()``:
    features: (V, D) float16 unit language features, zero where unknown. The features of a saved map stay coded
    (``language.feature_codec.CodedFeatures``) until ``np.asarray`` decodes them.  colors: (V, 3) uint8 RGB.
    """

    voxel_size: float
    origin: NDArray[np.float64]
    keys: NDArray[np.int32]
    probability: NDArray[np.float32]
    free: NDArray[np.uint16]
    hits: NDArray[np.uint16]
    state: NDArray[np.uint8]
    features: NDArray[np.float16] = field(default_factory=lambda: np.zeros((0, 0), np.float16))
    colors: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    levels: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))

    def __post_init__(self) -> None:
        if not len(self.levels):
            object.__setattr__(self, "levels", np.zeros(len(self.keys), np.uint8))

    @property
    def deepest(self) -> int:
        """The level of the smallest voxels."""
        return int(self.levels.max(initial=0))

    @property
    def finest(self) -> float:
        """The edge of the smallest voxels, meters: the unit of ``voxels`` and ``edges``."""
        return float(self.voxel_size / 2**self.deepest)

    def voxels(self, state: int) -> NDArray[np.int32]:
        """(V, 3) lower corners (i, j, k) of the voxels in ``state``, on the lattice of the smallest voxels, in storage
        order. In a map with one voxel size, these are the voxel indices."""
        block, local = np.nonzero(self.state == state)
        index = self.keys[block] * BLOCK + np.stack((local // 64, local // 8 % 8, local % 8), axis=1).astype(np.int32)
        return index * self._edges(block)[:, None] if self.deepest else index

    def edges(self, state: int) -> NDArray[np.int32]:
        """(V,) edges of the same voxels, in units of the smallest edge; all 1 in a map with one voxel size."""
        return self._edges(np.nonzero(self.state == state)[0])

    def _edges(self, block: NDArray[np.int64]) -> NDArray[np.int32]:
        return np.left_shift(1, self.deepest - self.levels[block].astype(np.int32), dtype=np.int32)

    def occupied_voxels(self) -> NDArray[np.int32]:
        """``voxels(OCCUPIED)``, cached and read-only, in the row order of ``features`` and ``colors``."""
        return self._occupied[0]

    def occupied_edges(self) -> NDArray[np.int32]:
        """``edges(OCCUPIED)``, cached and read-only."""
        return self._occupied[1]

    @functools.cached_property
    def _occupied(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        voxels, edges = self.voxels(OCCUPIED), self.edges(OCCUPIED)
        voxels.setflags(write=False)
        edges.setflags(write=False)
        return voxels, edges

    def centers(self, voxels: NDArray[np.int32], edges: NDArray[np.int32] | None = None) -> NDArray[np.float64]:
        """(V, 3) world positions of voxel centers, from corners and edges as above; edges are 1 by default."""
        half = 0.5 if edges is None else 0.5 * edges[:, None]
        return self.origin + (voxels + half) * self.finest

    def replace(self, **changes: object) -> Occupancy:
        """A copy with the given fields changed."""
        return replace(self, **changes)  # type: ignore[arg-type]
