"""Trajectories in TUM's format: what is written reads back, and damage is reported."""

import numpy as np
import pytest

from freeocc3d.capture.readers.synthetic import camera_on_the_walk
from freeocc3d.core.tum_files import read_tum, tum_poses, write_tum
from freeocc3d.core.types import Trajectory


def test_tum_poses_come_back(tmp_path) -> None:
    T = np.stack([camera_on_the_walk(p) for p in (0.0, 0.1, 0.2, 0.7)])
    T[2] = np.nan
    stamps = np.array([0.0, 1 / 30, 2 / 30, 1305031102.175304])
    trajectory = Trajectory(stamps, T, np.array([0], np.int32), np.array(["tracked"] * 4), np.ones(4, np.float32))
    write_tum(tmp_path / "t.txt", trajectory)
    times, poses = read_tum(tmp_path / "t.txt")
    np.testing.assert_array_equal(times, stamps[[0, 1, 3]])
    np.testing.assert_allclose(poses, T[[0, 1, 3]], atol=1e-7)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("1 2 3", "8 numbers"),
        ("0 0 0 0 0 0 0 0", "a quaternion is all zeros"),
        ("0 0 0 nan 0 0 0 1", "not finite"),
        ("a " * 8, "convert"),
        (f"0 1e10 {'0 ' * 5} 1", "too far away"),
        ("9" * 5000 + " 0" * 7, "too long for a number"),
    ],
)
def test_what_is_no_pose_is_reported(line: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        tum_poses([line.split()])


def test_tables_of_numbers_are_poses_as_lines_are() -> None:
    line = [3.5, 1, 2, 3, 0, 0, 0, 2]
    for found, expected in zip(tum_poses(np.array([line])), tum_poses([[str(n) for n in line]]), strict=True):
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(ValueError, match="not finite"):
        tum_poses(np.array([[np.nan, *line[1:]]]))


def test_a_file_without_poses_holds_none(tmp_path) -> None:
    (tmp_path / "t.txt").write_text("# nothing\n")
    times, poses = read_tum(tmp_path / "t.txt")
    assert (times.shape, poses.shape) == ((0,), (0, 4, 4))
