"""A piece of the built-in room, written in every format, comes back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scans import Scan, room_scan
from written_captures import WRITTEN, Written

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Capture
from freeocc3d.capture.rgbd_frames import RgbdFrames

COUNT = 6


@pytest.mark.parametrize("name", WRITTEN)
def test_a_piece_of_the_room_comes_back(tmp_path: Path, name: str) -> None:
    written = WRITTEN[name]
    scan = room_scan(COUNT, *written.size)
    capture = open_capture(written.write(tmp_path, scan), written.make_options())
    assert (capture.format, len(capture), capture.warnings) == (written.reader, COUNT, ())
    assert capture.intrinsics_known == written.cameras
    check_times(capture, scan, written)
    for index in (5, 0, 1, 4, 2, 3):
        check_images(capture, scan, written, index)
        check_pose(capture, scan, written, index)


def check_times(capture: Capture, scan: Scan, written: Written) -> None:
    if written.times_s is None:
        np.testing.assert_array_equal(capture.timestamps, np.arange(COUNT))
        return
    since = np.array(scan.times) - scan.times[0]
    np.testing.assert_allclose(capture.timestamps - capture.timestamps[0], since, atol=written.times_s)
    if capture.timestamps[0] > 100:  # not counted from the first frame
        np.testing.assert_allclose(capture.timestamps, scan.times, atol=written.times_s)


def check_images(capture: Capture, scan: Scan, written: Written, index: int) -> None:
    if not written.registered:
        assert isinstance(capture, RgbdFrames)
        np.testing.assert_array_equal(capture.stored_color(index), scan.color[index])
        stored = capture.stored_depth(index)
        assert stored is not None
        np.testing.assert_array_equal(stored[: scan.depth_size[1]], scan.stored(index))
        for lens in (capture.rig(index).color, capture.rig(index).depth):
            np.testing.assert_allclose(lens.camera.matrix, scan.K, rtol=1e-9)
        return
    frame = capture[index]
    np.testing.assert_array_equal(frame.color, scan.color[index])
    if written.cameras:
        expected = scan.cameras[index if written.own_cameras else 0]
        np.testing.assert_allclose(frame.intrinsics.matrix, expected.matrix, rtol=1e-7)
    assert frame.depth_sigma_m is None
    if written.unit_m is None:
        assert not capture.has_depth
        return
    assert capture.has_depth
    if not written.unit_m:
        np.testing.assert_array_equal(frame.depth_m, scan.depth_m[index])
    np.testing.assert_allclose(frame.depth_m, scan.depth_m[index], rtol=1e-6, atol=written.unit_m / 2)
    np.testing.assert_array_equal(frame.depth_m > 0, scan.depth_m[index] > 0)


def check_pose(capture: Capture, scan: Scan, written: Written, index: int) -> None:
    pose = capture.pose(index)
    if not written.poses:
        assert pose is None
        return
    assert pose is not None
    np.testing.assert_allclose(pose, scan.T_world_cam[index], atol=1e-6)
