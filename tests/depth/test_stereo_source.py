"""The depth source by multi-view stereo: the poses and points that it uses, and the frames that it returns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import wall_frame

from freeocc3d.core.errors import TrackingError
from freeocc3d.core.progress import Progress
from freeocc3d.depth import stereo_source
from freeocc3d.depth.base import MeasuredDepth
from freeocc3d.depth.multi_view_stereo import Options
from freeocc3d.tracking.base import PosedPoints
from freeocc3d.tracking.given_poses import GivenTracker

POSES = np.tile(np.eye(4), (3, 1, 1))
POINTS = PosedPoints(POSES, np.ones((5, 3), np.float32), np.zeros(5, np.int32), np.arange(5, dtype=np.int32))


class ColorOnly:
    path = Path("scan")


class WithPoints(GivenTracker):
    def posed_points(self) -> PosedPoints:
        return POINTS


class FrameByFrame(GivenTracker):
    def poses_ahead(self) -> None:
        return None


class StereoStub:
    """Two meters for frame 0, nothing for the others."""

    taken: PosedPoints

    def __init__(self, folder: Path, options: Options):
        self.folder = folder

    def compute(self, capture, scan, frames, progress, prepared) -> None:
        StereoStub.taken = scan

    def depth(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        shape = wall_frame(1.0).depth_m.shape
        return (np.full(shape, 2.0, np.float32), np.zeros(shape, np.float32)) if index == 0 else None


def test_points_of_the_tracker_are_taken_and_frames_get_depth(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(stereo_source, "StereoDepth", StereoStub)
    source = stereo_source.StereoSource(ColorOnly(), Options())
    source.prepare(WithPoints(POSES, 0.85), tmp_path, range(3), Progress())
    assert StereoStub.taken is POINTS
    frame = source.complete(wall_frame(1.0))
    assert (frame.depth_m == 2.0).all()
    assert (frame.depth_sigma_m == np.float32(0.0005)).all(), "half a millimeter at the surest"


def test_a_tracker_without_poses_ahead_is_refused(tmp_path: Path) -> None:
    source = stereo_source.StereoSource(ColorOnly(), Options())
    with pytest.raises(TrackingError, match=r"leave tracking\.backend at auto"):
        source.prepare(FrameByFrame(POSES, 0.85), tmp_path, range(3), Progress())


def test_measured_depth_is_left_as_it_is() -> None:
    frame = wall_frame(1.0)
    assert MeasuredDepth().complete(frame) is frame
