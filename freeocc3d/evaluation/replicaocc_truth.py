"""Builds the truth of a capture as the paper builds ReplicaOcc (supplement, "Benchmark Details").

(i)   Back-project every ``pixel_stride``-th pixel of every frame with the capture's own pose. The points of a voxel
      vote for its class with the values of the class images.
(ii)  Place the voxels into a regular grid over their extent, with lattice planes at ``lattice_offset`` + n * size.
(iii) A voxel is observed if, in some ``frame_stride``-th frame, its center lies in front of the camera, inside the
      image and no farther than the measured depth plus ``tolerance`` voxels.

An observed voxel has its class, or is free if it has none. All other voxels are 255.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta
from numba import prange
from numpy.typing import NDArray

from ..capture import open_capture, read_ahead, select_frames
from ..capture.base import Capture
from ..core.compiling import njit
from ..core.errors import ConfigError, FrameError, FreeOccError
from ..core.progress import Progress
from ..core.transforms import back_project, invert, transform
from ..core.typed_documents import InvalidDocument
from ..core.types import UNKNOWN, Frame
from ..core.voxel_keys import KEY_LIMIT, pack_voxels, unpack_voxels
from ..settings import config
from ..settings.option_types import Meters, PositiveInt, Stride, VoxelEdge
from ..settings.typed_options import TypedOptions
from ..settings.typed_options import build as build_options
from ..settings.yaml_files import parse_yaml
from . import scored_classes as taxonomy
from .true_occupancy import GroundTruth

_LARGEST_GRID = 1 << 29
_ROWS_BEFORE_MERGE = 4_000_000
_MOST_CLASSES = 254
UNLABELED = "occupied"
"""Class of every surface if a capture has no class images."""
Shift = Annotated[float, Meta(ge=-1000, le=1000)]


class Options(TypedOptions, frozen=True):
    """The protocol's parameters, with the paper's values."""

    voxel_size: VoxelEdge = 0.08
    """Edge of a voxel, meters."""
    pixel_stride: Stride = 4
    """Back-project every n-th pixel, in both directions."""
    frame_stride: PositiveInt = 2
    """Use every n-th frame to decide what is observed."""
    max_range: Meters = 10.0
    """Depth beyond this many meters counts as not measured."""
    lattice_offset: tuple[Shift, Shift, Shift] = (0.0, 0.0, 0.0)
    """Shift of the lattice, meters: half a voxel in z puts a floor at z = 0 inside a voxel, not on a face."""
    min_points: PositiveInt = 1
    """Least number of points of a voxel: sensor noise scatters some points into the voxels next to a surface."""
    fill: Literal["inside", "within"] = "inside"
    """"inside": a cell is occupied if a point lies in it; "within": also if a neighbor cell is, no farther than one
    voxel from center to center."""
    tolerance: Annotated[float, Meta(ge=0, le=1000)] = 1.0
    """How far an observed voxel's center may lie behind the measured depth, in voxel edges."""
    dilation: Annotated[int, Meta(ge=0, le=1000)] = 0
    """Grow the observed space by this many voxels, across faces."""


def build_truth(capture: str | Path, overrides: Sequence[str] = (), progress: Progress | None = None) -> GroundTruth:
    """Builds the truth of the capture in a folder. overrides: "name=value" of ``Options``, or "capture.name=value".

    Raises FreeOccError: no poses, nothing measured, a grid too large for memory; ConfigError.
    """
    own, of_capture = {}, []
    for override in overrides:
        name, separator, text = override.partition("=")
        if not separator:
            raise ConfigError(f"An option must be name=value, got '{override}'.")
        if name.startswith("capture."):
            of_capture.append(override)
        else:
            try:
                own[name.strip()] = parse_yaml(text)
            except InvalidDocument as error:
                raise ConfigError(f"The value in '{override}' is not valid YAML.") from error
    options = build_options(Options, own)
    settings = config.load(None, [f"capture.max_depth={options.max_range}", *of_capture])
    opened = open_capture(capture, settings.capture, settings.backends.get("capture"))
    return build_truth_from_capture(opened, options, progress)


def build_truth_from_capture(capture: Capture, options: Options, progress: Progress | None = None) -> GroundTruth:
    """Builds the truth of an open capture from its own poses and class images. It leaves out frames without a pose."""
    progress = progress or Progress()
    frames = [index for index in select_frames(capture) if capture.pose(index) is not None]
    if not frames:
        raise FreeOccError(f"{capture.path} has no poses: a ground truth needs them.")
    names, labels_of = _classes(capture, frames)
    votes = Votes(options, len(names))
    _each(capture, frames, "points", progress, lambda frame, T: votes.add(frame, T, labels_of(frame)))
    voxels, labels = votes.labeled()
    if not len(voxels):
        raise FreeOccError(f"{capture.path} measured nothing within {options.max_range:g} m, so there is no surface.")
    low = voxels.min(axis=0)
    grid = _grid(voxels - low, labels, options, str(capture.path))
    origin = np.array(options.lattice_offset) + low * options.voxel_size
    seen = np.zeros(grid.shape, bool)
    _each(
        capture,
        frames[:: options.frame_stride],
        "observed",
        progress,
        lambda frame, T: mark_observed(seen, frame, T, origin, options),
    )
    for _ in range(options.dilation):
        seen = _grown(seen)
    return GroundTruth(np.where(seen, grid, UNKNOWN).astype(np.uint8), origin, options.voxel_size, names)


class Votes:
    """(i): the points of each voxel by class. Memory grows with the surface, not with the number of frames."""

    def __init__(self, options: Options, classes: int):
        self.options = options
        self.classes = classes
        self._keys: list[NDArray[np.int64]] = []
        self._counts: list[NDArray[np.int64]] = []

    def add(self, frame: Frame, T_world_cam: NDArray[np.float64], labels: NDArray[np.uint8]) -> None:
        """Adds a frame. labels: (H, W) class image of the frame's size, 0 = no class."""
        step = self.options.pixel_stride
        depth = frame.depth_m[::step, ::step]
        v, u = np.nonzero((depth > 0) & (depth <= self.options.max_range))
        pixels = np.stack((u, v), axis=1).astype(np.float64) * step
        points = transform(T_world_cam, back_project(pixels, depth[v, u].astype(np.float64), frame.intrinsics))
        index = np.floor((points - self.options.lattice_offset) / self.options.voxel_size).astype(np.int64)
        inside = ((index >= -KEY_LIMIT) & (index < KEY_LIMIT)).all(axis=1)
        voxel = pack_voxels(index)
        label = labels[::step, ::step][v, u].astype(np.int64)
        order = np.lexsort((label[inside], voxel[inside]))
        pairs = np.stack((voxel[inside][order], label[inside][order]), axis=1)
        self._append(pairs, np.ones(len(pairs), np.int64))
        if sum(map(len, self._counts)) > _ROWS_BEFORE_MERGE:
            self._merge()

    def labeled(self) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Returns the (V, 3) voxels with points, and the (V,) class of most points; a tie goes to the first class in
        the list. Points without a class do not vote. A voxel with only such points is 255. A voxel with too few points
        is left out."""
        self._merge()
        if not self._keys:
            return np.zeros((0, 3), np.int64), np.zeros(0, np.uint8)
        (voxel, label), count = self._keys[0].T, self._counts[0]
        order = np.lexsort((label, -np.where(label > 0, count, 0), voxel))
        start = np.flatnonzero(np.diff(voxel[order], prepend=-1))
        enough = np.add.reduceat(count[order], start) >= self.options.min_points
        first = order[start[enough]]
        return unpack_voxels(voxel[first]).astype(np.int64), np.where(label[first] > 0, label[first], UNKNOWN).astype(
            np.uint8
        )

    def _append(self, pairs: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        """Adds (P, 2) sorted pairs (voxel, label) with their counts, and sums equal pairs."""
        if len(pairs):
            start = np.flatnonzero(np.append(True, (pairs[1:] != pairs[:-1]).any(axis=1)))
            self._keys.append(pairs[start])
            self._counts.append(np.add.reduceat(counts, start))

    def _merge(self) -> None:
        if len(self._keys) > 1:
            pairs, counts = np.concatenate(self._keys), np.concatenate(self._counts)
            order = np.lexsort((pairs[:, 1], pairs[:, 0]))
            self._keys, self._counts = [], []
            self._append(pairs[order], counts[order])


def mark_observed(
    seen: NDArray[np.bool_],
    frame: Frame,
    T_world_cam: NDArray[np.float64],
    origin: NDArray[np.float64],
    options: Options,
) -> None:
    """(iii): marks in ``seen`` (X, Y, Z) the voxels of the lattice at ``origin`` that one frame observes."""
    camera, T_cam_world = frame.intrinsics, invert(T_world_cam)
    depth = np.where(frame.depth_m <= options.max_range, frame.depth_m, 0).astype(np.float32)
    _observe(
        seen,
        T_cam_world[:3, :3] * options.voxel_size,
        T_cam_world[:3, :3] @ origin + T_cam_world[:3, 3],
        np.array((camera.fx, camera.fy, camera.cx, camera.cy)),
        depth,
        options.tolerance * options.voxel_size,
    )


@njit(parallel=True, cache=True)
def _observe(
    seen: NDArray[np.bool_],
    R: NDArray[np.float64],  # from voxels to meters in the camera's frame
    t: NDArray[np.float64],
    camera: NDArray[np.float64],
    depth_m: NDArray[np.float32],
    tolerance: float,
) -> None:
    fx, fy, cx, cy = camera
    height, width = depth_m.shape
    X, Y, Z = seen.shape
    for i in prange(X):
        for j in range(Y):
            for k in range(Z):
                if seen[i, j, k]:
                    continue
                x, y, z = i + 0.5, j + 0.5, k + 0.5
                depth = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
                if depth <= 0:
                    continue
                u = fx * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / depth + cx
                v = fy * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / depth + cy
                column, row = math.floor(u + 0.5), math.floor(v + 0.5)
                if column < 0 or row < 0 or column >= width or row >= height:
                    continue
                measured = depth_m[row, column]
                seen[i, j, k] = measured > 0 and depth <= measured + tolerance


def _classes(capture: Capture, frames: list[int]) -> tuple[tuple[str, ...], Callable[[Frame], NDArray[np.uint8]]]:
    """Returns the names of the classes, and a function that returns a frame's class image at the size of its depth."""
    if len(capture.classes) < 2 or capture.labels(frames[0]) is None:
        return (taxonomy.FREE, UNLABELED), lambda frame: np.ones(frame.depth_m.shape, np.uint8)
    if len(capture.classes) > _MOST_CLASSES + 1:
        raise FreeOccError(
            f"{capture.path} names more than {_MOST_CLASSES} classes, but a label is one byte: name fewer."
        )

    def labels_of(frame: Frame) -> NDArray[np.uint8]:
        image = capture.labels(frame.index)
        if image is None:
            return np.zeros(frame.depth_m.shape, np.uint8)
        if image.max(initial=0) >= len(capture.classes):
            image = np.where(image == UNKNOWN, 0, image)
            if image.max(initial=0) >= len(capture.classes):
                raise FreeOccError(
                    f"The class image of frame {frame.index} of {capture.path} has value {image.max()}, but only "
                    f"{len(capture.classes)} classes have names."
                )
        rows, columns = (
            ((np.arange(size) + 0.5) * own / size).astype(np.int64)
            for size, own in zip(frame.depth_m.shape, image.shape, strict=True)
        )
        return np.asarray(image[rows[:, None], columns])

    return (taxonomy.FREE, *capture.classes[1:]), labels_of


def _each(
    capture: Capture,
    frames: Sequence[int],
    stage: str,
    progress: Progress,
    work: Callable[[Frame, NDArray[np.float64]], None],
) -> None:
    """Decodes the frames and calls ``work`` with each frame and its pose. Reports broken frames and leaves them out."""
    progress.stage(stage, len(frames))
    for done, (index, frame) in enumerate(read_ahead(capture, frames), start=1):
        T_world_cam = capture.pose(index)
        if isinstance(frame, FrameError):
            progress.warn(str(frame))
        elif T_world_cam is not None:
            work(frame, T_world_cam)
        progress.advance(done)


def _grid(voxels: NDArray[np.int64], labels: NDArray[np.uint8], options: Options, source: str) -> NDArray[np.uint8]:
    """(ii): returns the (X, Y, Z) labels over the extent of the voxels, 0 for cells without a voxel."""
    shape = voxels.max(axis=0) + 1
    if math.prod(shape.tolist()) > _LARGEST_GRID:
        size = " x ".join(str(n) for n in shape)
        raise FreeOccError(
            f"The points of {source} spread over {size} voxels of {options.voxel_size:g} m, too many for memory: check "
            "its poses and depth scale, or use larger voxels."
        )
    grid = np.zeros(shape, np.uint8)
    grid[tuple(voxels.T)] = labels
    if options.fill == "within":
        inside = grid.copy()
        for axis in range(3):  # a tie between neighbors goes to the first in this order
            for ahead in (False, True):
                here, there = _neighbors(axis, ahead)
                free = grid[here] == 0
                grid[here][free] = inside[there][free]
    return grid


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns the mask, grown by the voxels that share a face with it."""
    grown = mask.copy()
    for axis in range(3):
        for ahead in (False, True):
            here, there = _neighbors(axis, ahead)
            grown[here] |= mask[there]
    return grown


def _neighbors(axis: int, ahead: bool) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Returns slices that pair each voxel with its neighbor along an axis."""
    low, high = [slice(None)] * 3, [slice(None)] * 3
    low[axis], high[axis] = slice(None, -1), slice(1, None)
    return (tuple(low), tuple(high)) if ahead else (tuple(high), tuple(low))
