"""The warnings after a run."""

from __future__ import annotations

import numpy as np

from freeocc3d.core.types import Trajectory
from freeocc3d.pipeline.checks import warn_of_trajectory


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


def test_a_scan_that_is_mostly_lost_gets_advice() -> None:
    (notice,) = warn_of_trajectory(trajectory("keyframe", "lost", "lost"))
    assert "Most of the scan is missing" in notice.text
