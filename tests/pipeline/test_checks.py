"""The warnings after a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from freeocc3d.core.types import Frame, Intrinsics, Trajectory
from freeocc3d.pipeline.checks import check_brightness, check_projection, warn_of_trajectory
from freeocc3d.settings import config


def trajectory(*status: str) -> Trajectory:
    T = np.tile(np.eye(4), (len(status), 1, 1))
    times, keyframes = np.arange(len(status), dtype=float), np.zeros(1, np.int32)
    return Trajectory(times, T, keyframes, np.array(status), np.ones(len(status), np.float32))


def test_a_whole_scan_raises_no_warning() -> None:
    assert not list(warn_of_trajectory(trajectory("keyframe", "tracked", "unused")))


def test_each_way_of_missing_frames_has_its_code() -> None:
    found = list(warn_of_trajectory(trajectory("keyframe", "broken", "lost", "lost", "apart", "unused")))
    assert [notice.code for notice in found] == ["broken-frames", "frames-lost", "submaps-apart"]
    broken, lost, apart = (notice.text for notice in found)
    assert broken.startswith("1 frame could not be read and was skipped")
    assert "lost 2 frames (40%), the first is frame 2" in lost
    assert "the first is frame 4" in apart


@pytest.mark.parametrize(("dark", "told"), [(0, False), (2, False), (3, True), (5, True)])
def test_a_scan_that_is_mostly_dark_is_told(dark: int, told: bool) -> None:
    """A room at night is dark in a few places; a lamp in a dark frame is bright."""
    K = Intrinsics(20, 10, 20.0, 20.0, 10.0, 5.0)
    colors = [np.full((10, 20, 3), 16 if row < dark else 90, np.uint8) for row in range(5)]
    colors[4][:, :2] = 200
    frames = [Frame(row, float(row), color, np.ones((10, 20), np.float32), K) for row, color in enumerate(colors)]
    notice = check_brightness(frames[: max(dark, 4)], Path("scan"))
    assert (notice is not None) == told
    assert notice is None or f"{min(dark, 4)} of " in notice.text


@pytest.mark.parametrize(
    ("initialization", "projection", "told"),
    [("disc", "integrated", False), ("disc", "probabilistic", True), ("ray_aligned", "probabilistic", False)],
)
def test_a_projection_that_misses_discs_is_told(initialization: str, projection: str, told: bool) -> None:
    options = {"gaussians": {"initialization": initialization}, "occupancy": {"projection": projection}}
    assert (check_projection(config.resolve(options)) is not None) == told


def test_a_scan_that_is_mostly_lost_gets_advice() -> None:
    (notice,) = warn_of_trajectory(trajectory("keyframe", "lost", "lost"))
    assert "Most of the scan is missing" in notice.text
