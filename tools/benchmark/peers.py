"""The strongest peers that run on a CPU, for comparison with our own map on the same frames and poses.

    dense_slam               Open3D's dense SLAM (``t.pipelines.slam``): color and depth to poses
    surface_area             Open3D's TSDF (``t.geometry.VoxelBlockGrid``): the surface at given poses
    back_projected_occupied  the plainest baseline: depth pixels added up in the voxels that they fall in
    octomap_occupied         OctoMap (A. Hornung et al., OctoMap, Autonomous Robots 2013) through pyoctomap

Every parameter is a constant of this module, the same for all captures. Those of the occupancy peers were chosen once,
in their favor, on 7-Scenes' kitchen and two rendered rooms together. The libraries' published values stay as they are,
except where a constant below gives a reason. A capture's reader has already dropped depth beyond the sensor's range, so
the occupancy peers use all depth that is left. They use the same frames, every second one with a pose, and the same
lattice, in the frame of the poses. They have no unknown state: a voxel that they have not seen is not occupied. A frame
that cannot be decoded is left out.

The kitchen's truth is itself a TSDF of that capture at its own poses. There, a TSDF at the same poses is nearly
compared with itself.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from freeocc3d.capture import Capture
from freeocc3d.core.errors import DependencyError, FrameError
from freeocc3d.core.transforms import back_project, invert, transform
from freeocc3d.core.types import Frame

from .timing import Seconds, lap, start_steps

SLAM_VOXEL_SIZE_M = 0.01
SLAM_DEPTH_MIN_M, SLAM_DEPTH_MAX_M = 0.1, 6.0
SLAM_DEPTH_DIFF_M = 0.07
SLAM_TRUNCATION_VOXELS = 8.0
SLAM_BLOCKS = 40_000
"""Open3D's examples/python/t_reconstruction_system/default_config.yml, except for the voxel size and the largest depth,
which is 3 m there: with the sensor's 6 m the kitchen's error stays the same, and the house's bedroom is not lost."""

SLAM_UNITS_PER_METER = 5000.0
"""Units of dense SLAM's 16-bit depth: no rounding for captures in millimeters, and a range of 13 m."""

TSDF_VOXEL_SIZE_M = 0.02
TSDF_TRUNCATION_VOXELS = 4.0
"""8 cm, half of Open3D's default: with 16 cm the two faces of doors, boards and table tops blot each other out."""

TSDF_MIN_WEIGHT = 1.0
"""A corner of the surface needs more observations than this. Open3D's default 3 drops what few frames have seen."""

TSDF_MIN_AREA_M2 = 6e-4
"""Smallest surface in an occupied voxel: the smallest that the kitchen's truth counts."""

PIXEL_STRIDE = 4
"""Every n-th pixel of every n-th row is back-projected, or cast as a ray. At 6 m and 640 x 480, points are then 5 cm
apart, less than a voxel."""

MIN_SEEN_FACES = 1.0
"""Smallest seen area of an occupied voxel, in faces of a voxel. A pixel counts the area that it covers at its depth, so
near and far sides of a room need the same area."""


@dataclass(frozen=True)
class Lattice:
    """The lattice of the occupancy: voxel (i, j, k) covers ``origin + [i, i+1) * voxel_size``.

    origin: (3,) lower corner of voxel (0, 0, 0) in the frame of the poses, meters.
    shape: voxels along x, y and z.  voxel_size: edge of a voxel, meters.
    """

    origin: NDArray[np.float64]
    shape: tuple[int, int, int]
    voxel_size: float

    def total(self, points: NDArray[np.floating], weights: NDArray[np.floating]) -> NDArray[np.float64]:
        """(X, Y, Z) sum of the weights (P,) of the points (P, 3) in each voxel; points outside count nowhere."""
        voxels = np.floor((points - self.origin) / self.voxel_size).astype(np.int64)
        inside = ((voxels >= 0) & (voxels < self.shape)).all(axis=1)
        flat = np.ravel_multi_index(tuple(voxels[inside].T), self.shape)
        sums = np.bincount(flat, weights[inside], minlength=int(np.prod(self.shape)))
        return np.asarray(sums, np.float64).reshape(self.shape)


def dense_slam(capture: Capture, frames: Sequence[int]) -> tuple[NDArray[np.float64], Seconds, int]:
    """Decode, track, integrate and synthesize the given frames, in their order.

    Returns T_world_cam (N, 4, 4) of the capture's N frames, where the world is the first camera and unused frames are
    NaN; the seconds of each step; and the number of frames whose tracking failed, which keep the last pose.
    """
    import open3d as o3d

    first = capture[frames[0]]
    camera = o3d.core.Tensor(first.intrinsics.matrix)
    height, width = first.depth_m.shape
    device = o3d.core.Device("CPU:0")
    T_world_cam = o3d.core.Tensor(np.eye(4))
    model = o3d.t.pipelines.slam.Model(SLAM_VOXEL_SIZE_M, 16, SLAM_BLOCKS, T_world_cam, device)
    measured = o3d.t.pipelines.slam.Frame(height, width, camera, device)
    rendered = o3d.t.pipelines.slam.Frame(height, width, camera, device)

    seconds = start_steps("decode", "track", "integrate", "synthesize")
    poses = np.full((len(capture), 4, 4), np.nan)
    failures = 0
    for count, index in enumerate(frames):
        mark = time.perf_counter()
        frame = capture[index]
        depth = np.rint(frame.depth_m * SLAM_UNITS_PER_METER).astype(np.uint16)
        measured.set_data_from_image("depth", o3d.t.geometry.Image(depth))
        measured.set_data_from_image("color", o3d.t.geometry.Image(frame.color))
        mark = lap(seconds, "decode", mark)
        if count > 0:
            try:
                result = model.track_frame_to_model(
                    measured, rendered, SLAM_UNITS_PER_METER, SLAM_DEPTH_MAX_M, SLAM_DEPTH_DIFF_M
                )
                T_world_cam = T_world_cam @ result.transformation
            except RuntimeError:
                failures += 1
        mark = lap(seconds, "track", mark)
        poses[index] = T_world_cam.numpy()
        model.update_frame_pose(count, T_world_cam)
        model.integrate(measured, SLAM_UNITS_PER_METER, SLAM_DEPTH_MAX_M, SLAM_TRUNCATION_VOXELS)
        mark = lap(seconds, "integrate", mark)
        model.synthesize_model_frame(
            rendered, SLAM_UNITS_PER_METER, SLAM_DEPTH_MIN_M, SLAM_DEPTH_MAX_M, SLAM_TRUNCATION_VOXELS, False
        )
        lap(seconds, "synthesize", mark)
    return poses, seconds, failures


def frames_with_pose(T_world_cam: NDArray[np.float64], every: int) -> NDArray[np.int64]:
    """Every n-th frame with a finite pose in (N, 4, 4): the frames that the occupancy peers use."""
    return np.flatnonzero(np.isfinite(T_world_cam).all(axis=(1, 2)))[::every]


def surface_area(
    capture: Capture, T_world_cam: NDArray[np.float64], lattice: Lattice, every: int
) -> tuple[NDArray[np.float64], Seconds]:
    """(X, Y, Z) square meters of the TSDF's surface in each voxel. A triangle belongs to the voxel of its centroid."""
    import open3d as o3d

    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"),
        (core.float32, core.float32),
        ((1,), (1,)),
        TSDF_VOXEL_SIZE_M,
        device=core.Device("CPU:0"),
    )
    seconds = start_steps("decode", "integrate", "extract")
    integrated = 0
    for frame in _decoded(capture, frames_with_pose(T_world_cam, every), seconds):
        if not frame.depth_m.any():
            continue
        mark = time.perf_counter()
        depth = o3d.t.geometry.Image(np.ascontiguousarray(frame.depth_m))
        camera, T_cam_world = core.Tensor(frame.intrinsics.matrix), core.Tensor(invert(T_world_cam[frame.index]))
        reach = 1.0, float(frame.depth_m.max()) + 1.0, TSDF_TRUNCATION_VOXELS
        blocks = grid.compute_unique_block_coordinates(depth, camera, T_cam_world, *reach)
        grid.integrate(blocks, depth, camera, T_cam_world, *reach)
        integrated += 1
        lap(seconds, "integrate", mark)
    mark = time.perf_counter()
    corners = _corners(grid) if integrated else np.zeros((0, 3, 3))
    a, b, c = corners.transpose(1, 0, 2)
    area = lattice.total(corners.mean(axis=1), 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    lap(seconds, "extract", mark)
    return area, seconds


def _corners(grid: Any) -> NDArray[np.float64]:
    """(T, 3, 3) corners of the triangles of a VoxelBlockGrid's surface."""
    try:
        mesh = grid.extract_triangle_mesh(TSDF_MIN_WEIGHT)
    except RuntimeError as error:
        if "SetVertexColors" not in str(error):
            raise
        return np.zeros((0, 3, 3))  # Open3D 0.20 fails on a surface without a vertex
    return np.asarray(mesh.vertex.positions.numpy()[mesh.triangle.indices.numpy()], np.float64)


def back_projected_occupied(
    capture: Capture, T_world_cam: NDArray[np.float64], lattice: Lattice, every: int = 2
) -> tuple[NDArray[np.bool_], Seconds]:
    """Voxels (X, Y, Z) of the lattice in which enough depth pixels fall, and the seconds of each step.

    T_world_cam: (N, 4, 4) poses in the lattice's frame, NaN for frames without one.
    """
    area, seconds = seen_area(capture, T_world_cam, lattice, every)
    return area >= MIN_SEEN_FACES * lattice.voxel_size**2, seconds


def seen_area(
    capture: Capture, T_world_cam: NDArray[np.float64], lattice: Lattice, every: int
) -> tuple[NDArray[np.float64], Seconds]:
    """(X, Y, Z) square meters that the depth pixels in each voxel cover at their depth, summed over the frames."""
    seconds = start_steps("decode", "count")
    area = np.zeros(lattice.shape)
    for frame in _decoded(capture, frames_with_pose(T_world_cam, every), seconds):
        mark = time.perf_counter()
        points_cam = _points(frame)
        camera = frame.intrinsics
        covered = (PIXEL_STRIDE * points_cam[:, 2]) ** 2 / (camera.fx * camera.fy)
        area += lattice.total(transform(T_world_cam[frame.index], points_cam), covered)
        lap(seconds, "count", mark)
    return area, seconds


def octomap_occupied(
    capture: Capture, T_world_cam: NDArray[np.float64], lattice: Lattice, every: int = 2
) -> tuple[NDArray[np.bool_], Seconds]:
    """Voxels (X, Y, Z) of the lattice that an OcTree of their size calls occupied, and the seconds of each step.

    The sensor model is OctoMap's own: a ray's end counts 0.7 and its way 0.4, clamped to 0.12 … 0.97; occupied from
    0.5. The length of rays has no further limit.

    T_world_cam: (N, 4, 4) poses in the lattice's frame, NaN for frames without one. Raises DependencyError if pyoctomap
    is not installed.
    """
    try:
        import pyoctomap
    except ImportError as error:
        raise DependencyError("The OctoMap peer needs pyoctomap: pip install 'pyoctomap>=1.2'.") from error

    tree = pyoctomap.OcTree(lattice.voxel_size)
    seconds = start_steps("decode", "insert", "read")
    for frame in _decoded(capture, frames_with_pose(T_world_cam, every), seconds):
        mark = time.perf_counter()
        T_tree_cam = T_world_cam[frame.index].copy()
        T_tree_cam[:3, 3] -= lattice.origin  # a tree's cells lie at multiples of their size: now they are the voxels
        tree.insertPointCloud(transform(T_tree_cam, _points(frame)), T_tree_cam[:3, 3].copy())
        lap(seconds, "insert", mark)
    mark = time.perf_counter()
    centers = (np.indices(lattice.shape).reshape(3, -1).T + 0.5) * lattice.voxel_size
    occupied = tree.getLabels(centers).reshape(lattice.shape) == 1
    lap(seconds, "read", mark)
    return occupied, seconds


def _decoded(capture: Capture, frames: NDArray[np.int64], seconds: Seconds) -> Iterator[Frame]:
    """The frames that can be decoded. Adds the time of decoding."""
    for index in frames:
        mark = time.perf_counter()
        try:
            frame = capture[int(index)]
        except FrameError:
            continue
        lap(seconds, "decode", mark)
        yield frame


def _points(frame: Frame) -> NDArray[np.float64]:
    """(P, 3) measured points of every ``PIXEL_STRIDE``-th pixel of every such row, camera, meters."""
    depth_m = frame.depth_m[::PIXEL_STRIDE, ::PIXEL_STRIDE]
    rows, columns = np.nonzero(depth_m > 0)
    pixels = PIXEL_STRIDE * np.stack((columns, rows), axis=1).astype(np.float64)
    return back_project(pixels, depth_m[rows, columns].astype(np.float64), frame.intrinsics)
