"""The benchmark's peers on a wall with known voxels."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from benchmark import peers
from numpy.typing import NDArray
from scenes import CAMERA, wall_frame

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.base import Capture
from freeocc3d.core.errors import DependencyError, FrameError
from freeocc3d.core.transforms import invert
from freeocc3d.core.types import Frame


def tsdf_occupied(capture: Capture, T_world_cam: np.ndarray, lattice: peers.Lattice, every: int = 2) -> tuple:
    area, seconds = peers.surface_area(capture, T_world_cam, lattice, every)
    return area >= peers.TSDF_MIN_AREA_M2, seconds


PEERS = [tsdf_occupied, peers.back_projected_occupied, peers.octomap_occupied]
DISTANCE_M = 2.0
STEP_M = 0.03
VOXEL_M = 0.08
FRAMES = 12
PLANE = 3
"""Index along x of the voxels in whose middle the wall stands."""

LATTICE = peers.Lattice(np.array((DISTANCE_M - (PLANE + 0.5) * VOXEL_M, -1.9, -1.33)), (7, 45, 30), VOXEL_M)


class Wall(Capture):
    """A camera that slides sideways along a wall; some of its frames are broken."""

    format = layout = "wall"

    def __init__(self, broken: tuple[int, ...] = ()) -> None:
        super().__init__(Path("wall"), Options())
        self.timestamps = np.arange(FRAMES, dtype=np.float64)
        self.broken = broken
        self.asked: list[int] = []

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False

    def __getitem__(self, index: int) -> Frame:
        self.asked.append(index)
        if index in self.broken:
            raise FrameError(f"frame {index}")
        return wall_frame(DISTANCE_M, index)

    def pose(self, index: int) -> NDArray[np.float64]:
        raise AssertionError("peers work at the poses that they are given")


def poses() -> NDArray[np.float64]:
    """(N, 4, 4) T_world_cam: looking along the world's x, sliding to its left, z up."""
    T_world_cam = np.tile(np.eye(4), (FRAMES, 1, 1))
    T_world_cam[:, :3, :3] = np.transpose(((0, -1, 0), (0, 0, -1), (1, 0, 0)))
    T_world_cam[:, 1, 3] = STEP_M * np.arange(FRAMES)
    return T_world_cam


def seen_wall(frames: range, always: bool) -> NDArray[np.bool_]:
    """(X, Y, Z) voxels of the wall that lie wholly in the view of all the frames, or partly in that of one."""
    half = DISTANCE_M * (np.array((CAMERA.width, CAMERA.height)) / 2 - 0.5) / CAMERA.fx
    slid = STEP_M * np.array((frames[0], frames[-1]))
    lo, hi = np.array((slid[0], 0.0)) - half, np.array((slid[-1], 0.0)) + half
    lower = LATTICE.origin[1:] + np.moveaxis(np.indices(LATTICE.shape[1:]), 0, -1) * VOXEL_M
    if always:
        lo[0], hi[0] = slid[-1] - half[0], slid[0] + half[0]
        inside = (lower >= lo) & (lower + VOXEL_M <= hi)
    else:
        inside = (lower + VOXEL_M > lo) & (lower < hi)
    wall = np.zeros(LATTICE.shape, bool)
    wall[PLANE] = inside.all(axis=-1)
    return wall


def grown(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The voxels and all that touch them."""
    out = np.zeros_like(voxels)
    padded = np.pad(voxels, 1)
    for i, j, k in itertools.product(range(3), repeat=3):
        out |= padded[i:, j:, k:][tuple(slice(n) for n in voxels.shape)]
    return out


@pytest.mark.parametrize("peer", PEERS)
def test_a_wall_is_occupied_and_nothing_else(peer) -> None:
    occupied, seconds = peer(Wall(), poses(), LATTICE)
    assert occupied.dtype == np.bool_
    assert occupied.shape == LATTICE.shape
    wall = seen_wall(range(FRAMES), always=True)
    assert wall.sum() > 300
    assert occupied[wall].all()
    assert not (occupied & ~grown(seen_wall(range(FRAMES), always=False))).any()
    assert "decode" in seconds
    assert all(value > 0 for value in seconds.values())


@pytest.mark.parametrize("peer", PEERS)
def test_the_lattice_and_the_poses_share_any_frame(peer) -> None:
    T_other_world = np.eye(4)
    T_other_world[:3, :3] = ((0, 0, 1), (1, 0, 0), (0, 1, 0))
    T_other_world[:3, 3] = 0.313, -4.77, 1.004
    corner = T_other_world[:3, :3] @ LATTICE.origin + T_other_world[:3, 3]
    moved = peers.Lattice(corner, (LATTICE.shape[2], LATTICE.shape[0], LATTICE.shape[1]), VOXEL_M)
    occupied, _ = peer(Wall(), poses(), LATTICE)
    elsewhere, _ = peer(Wall(), T_other_world @ poses(), moved)
    differing = occupied != elsewhere.transpose(1, 2, 0)
    assert not differing[seen_wall(range(FRAMES), always=True)].any()
    assert differing.sum() < 0.1 * occupied.sum()  # its rim, which the views touch, but do not fill


@pytest.mark.parametrize("peer", PEERS)
def test_every_nth_frame_with_a_pose_is_used_and_no_other(peer) -> None:
    capture, known = Wall(broken=(3,)), poses()
    known[[0, 4, 5]] = np.nan
    known[7, 0, 3] = np.nan
    occupied, _ = peer(capture, known, LATTICE, every=2)
    assert capture.asked == peers.frames_with_pose(known, 2).tolist() == [1, 3, 8, 10]
    assert occupied[seen_wall(range(1, 11), always=True)].all()  # frame 3 is broken and left out


@pytest.mark.parametrize("peer", PEERS)
def test_without_a_pose_nothing_is_occupied(peer) -> None:
    occupied, _ = peer(Wall(), np.full((FRAMES, 4, 4), np.nan), LATTICE)
    assert occupied.shape == LATTICE.shape
    assert not occupied.any()


def test_a_single_look_is_too_little_for_the_tsdf() -> None:
    occupied, _ = tsdf_occupied(Wall(), poses(), LATTICE, every=FRAMES)
    assert not occupied.any()


def test_seen_area_is_that_of_the_wall() -> None:
    area, _ = peers.seen_area(Wall(), poses(), LATTICE, every=3)
    pixels = CAMERA.width * CAMERA.height
    assert area[PLANE].sum() == pytest.approx(4 * pixels * (DISTANCE_M / CAMERA.fx) ** 2)
    assert area.sum() == pytest.approx(area[PLANE].sum())


def test_surface_area_is_that_of_the_wall() -> None:
    area, _ = peers.surface_area(Wall(), poses(), LATTICE, every=1)
    inner = seen_wall(range(FRAMES), always=True)
    assert area[inner].mean() == pytest.approx(VOXEL_M**2, rel=0.02)


def test_weights_add_up_in_their_voxels() -> None:
    rng = np.random.default_rng(0)
    lattice = peers.Lattice(np.array((-0.3, 0.1, 0.2)), (4, 3, 5), 0.25)
    points, weights = rng.uniform(-1, 2, (2000, 3)), rng.random(2000)
    expected = np.zeros(lattice.shape)
    for point, weight in zip(points, weights, strict=True):
        i, j, k = (int(n) for n in np.floor((point - lattice.origin) / lattice.voxel_size))
        if 0 <= i < 4 and 0 <= j < 3 and 0 <= k < 5:
            expected[i, j, k] += weight
    np.testing.assert_allclose(lattice.total(points, weights), expected)


def test_octomap_says_what_is_missing(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyoctomap", None)
    with pytest.raises(DependencyError, match="pip install"):
        peers.octomap_occupied(Wall(), poses(), LATTICE)


def test_dense_slam_follows_the_room(monkeypatch) -> None:
    monkeypatch.setattr(peers, "SLAM_BLOCKS", 2000)  # all that three frames need, and allocated at once
    capture = open_capture("builtin:room")
    frames = range(2, 6)
    T_first_cam, seconds, failures = peers.dense_slam(capture, frames)
    assert np.flatnonzero(np.isfinite(T_first_cam).all(axis=(1, 2))).tolist() == list(frames)
    assert np.array_equal(T_first_cam[2], np.eye(4))
    T_cam_first_true = invert(capture.pose(5)) @ capture.pose(2)
    error = T_cam_first_true @ T_first_cam[5]
    assert np.linalg.norm(error[:3, 3]) < 0.08
    assert np.degrees(np.arccos((np.trace(error[:3, :3]) - 1) / 2)) < 2  # of 5 degrees
    assert set(seconds) == {"decode", "track", "integrate", "synthesize"}
    assert failures == 0
