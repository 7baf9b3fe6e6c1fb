"""The picture of the camera path: drawn at the right place, with separate submaps next to it."""

from pathlib import Path

import cv2
import numpy as np
from scenes import gaussians
from small_captures import pose_matrix

from freeocc3d.core.types import Submap, Trajectory
from freeocc3d.viewer import trajectory_picture


def submap(frames: range, keyframes: list[int], closures=(), held=()) -> Submap:
    return Submap(
        np.array(frames, np.int32),
        np.stack([pose_matrix(i) for i in frames]),
        np.array(keyframes, np.int32),
        np.array(closures, np.int32).reshape(-1, 2),
        np.array(held, bool),
    )


UP = np.array((0.0, -1.0, 0.0))


def trajectory(status: list[str]) -> Trajectory:
    posed = np.array([name not in ("lost", "apart", "unused") for name in status])
    T = np.where(posed[:, None, None], np.stack([pose_matrix(i) for i in range(len(status))]), np.nan)
    keyframes = np.array([n for n, name in enumerate(status) if name == "keyframe"], np.int32)
    return Trajectory(np.arange(len(status), dtype=float), T, keyframes, np.array(status), np.ones(len(status)))


def drawn(
    path: Path, submaps: list[Submap], status: list[str], points=((0, 0, 2), (1, 0, 2), (0.5, 0.2, 3))
) -> np.ndarray:
    trajectory_picture.write_path_picture(path, submaps, trajectory(status), gaussians(points, 0.02), UP, Path("scan"))
    picture = cv2.imread(str(path))[:, :, ::-1]
    assert picture.shape == (trajectory_picture.SIZE[1], trajectory_picture.SIZE[0], 3)
    return picture


def pixels(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    return int((np.abs(picture.astype(int) - color).max(axis=-1) < 8).sum())


STATUS = ["keyframe", "tracked", "relocalised", "keyframe", "interpolated", "tracked", "keyframe"]


def test_the_way_its_keyframes_and_closures_are_drawn(tmp_path) -> None:
    with_closures = submap(range(7), [0, 3, 6], [(6, 0), (3, 0)], [True, False])
    picture = drawn(tmp_path / "a.png", [with_closures], STATUS)
    plain = drawn(tmp_path / "b.png", [submap(range(7), [0, 3, 6])], STATUS)
    for color in (
        trajectory_picture._TRACKED,
        trajectory_picture._KEYFRAME,
        trajectory_picture._FOUND,
        trajectory_picture._BETWEEN,
    ):
        assert pixels(plain, color) > 50
    assert pixels(picture, trajectory_picture._HELD) > pixels(plain, trajectory_picture._HELD) + 50
    assert pixels(picture, trajectory_picture._WRONG) > pixels(plain, trajectory_picture._WRONG) + 50


def test_submaps_apart_stand_next_to_it(tmp_path) -> None:
    status = [*STATUS, "apart", "apart"]
    one = [submap(range(7), [0, 3, 6])]
    alone = drawn(tmp_path / "a.png", one, status)
    both = drawn(tmp_path / "b.png", [*one, submap(range(7, 9), [7])], status)
    right = (slice(100, 900), slice(-trajectory_picture._ASIDE, None))
    assert pixels(both[right], trajectory_picture._KEYFRAME) > 0
    label = (slice(trajectory_picture._BAR, trajectory_picture._BAR + 30), slice(-trajectory_picture._ASIDE, None))
    assert (alone[label] > 120).all()
    assert (both[label] < 120).any()
    many = [submap(range(7, 9), [7])] * 6
    drawn(tmp_path / "c.png", [*one, *many], status)


def test_a_camera_that_never_moved_is_drawn_too(tmp_path) -> None:
    still = submap(range(1), [0])
    assert pixels(drawn(tmp_path / "a.png", [still], ["keyframe"]), trajectory_picture._KEYFRAME) > 0
    assert (
        pixels(drawn(tmp_path / "b.png", [still], ["keyframe"], points=[(0, 0, 1)]), trajectory_picture._KEYFRAME) > 0
    )
