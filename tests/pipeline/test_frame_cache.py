"""The cache of frames: what comes back, from the disk or, where it is full or empty, from the capture."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scenes import wall_frame, with_sigma

from freeocc3d.core.depth_sensors import STEREO
from freeocc3d.core.errors import FrameError
from freeocc3d.core.types import Frame
from freeocc3d.pipeline import frame_cache
from freeocc3d.pipeline.frame_cache import FrameCache
from freeocc3d.pipeline.packed_depth import pack_depth, pack_reference, unpack_depth


def frame(index: int, units: float = 1000.0) -> Frame:
    """A wall with noise, holes and a jump, in whole units."""
    made = wall_frame(2.0 + 0.1 * index, index, seed=index)
    depth = np.rint(made.depth_m * np.float32(units)).astype(np.float32) * np.float32(1 / units)
    depth[10:20, 30:60], depth[50:, 100:] = 0, np.float32(4.0)
    return replace(made, depth_m=depth)


def opened(folder, frames: list[Frame], shrink: int = 1) -> tuple[FrameCache, list[int]]:
    """A cache of a capture of these frames, and the indices that it reads from the capture."""
    asked: list[int] = []

    def read(index: int) -> Frame:
        asked.append(index)
        if index == len(frames):
            raise FrameError("broken")
        return frames[index]

    return FrameCache(folder, read, lambda frame: shrink), asked


@pytest.mark.parametrize("case", ["noise", "jumps", "zeros", "constant"])
def test_packed_depth_comes_back_and_is_that_of_numpy(case: str) -> None:
    rng = np.random.default_rng(0)
    values = {
        "noise": 2000 + rng.integers(-200, 200, (13, 17)),
        "jumps": rng.integers(0, 65536, (13, 17)),
        "zeros": np.zeros((13, 17)),
        "constant": np.full((13, 17), 65535),
    }[case].astype(np.uint16)
    for units, asked in ((4.0, True), (1.0, False)):
        packed, exact = pack_depth(values * np.float32(0.25), units)
        expected, expected_exact = pack_reference(values * np.float32(0.25), units)
        np.testing.assert_array_equal(packed, expected)
        assert exact == expected_exact
        assert exact == (asked or case == "zeros")
    packed, _ = pack_depth(values * np.float32(0.25), 4.0)
    np.testing.assert_array_equal(unpack_depth(packed, values.shape, 0.25), values.astype(np.float32) * 0.25)


@pytest.mark.parametrize("units", [1000.0, 5000.0])
def test_frames_come_back_in_the_asked_order_with_depth_as_it_was(tmp_path, units: float) -> None:
    frames = [frame(n, units) for n in range(8)]
    cache, asked = opened(tmp_path, frames)
    for each in frames:
        cache.keep(each)
    found = list(cache.frames([5, 0, 7, 0]))
    assert [each.index for each in found] == [5, 0, 7, 0]
    assert not asked
    assert not list(tmp_path.iterdir()), "its file has no name"
    for each in found:
        was = frames[each.index]
        np.testing.assert_array_equal(each.depth_m, was.depth_m)
        assert (each.timestamp, each.intrinsics, each.depth_sigma_m) == (was.timestamp, was.intrinsics, None)
        assert np.median(np.abs(each.color.astype(int) - was.color)) < 6


def test_depth_of_any_unit_and_its_deviations_come_back_to_fractions_of_a_millimeter(tmp_path) -> None:
    made = with_sigma(replace(frame(0), depth_m=frame(0).depth_m * np.float32(0.9137), sensor=STEREO), 0.001, 0.3)
    cache, _ = opened(tmp_path, [made], shrink=2)
    cache.keep(made)
    (found,) = cache.frames([0])
    assert found.color.shape == made.color.shape
    assert found.sensor is STEREO
    (without,) = cache.frames([0], color=False)
    assert not without.color.size
    np.testing.assert_array_equal(without.depth_m, found.depth_m)
    measured = made.depth_m > 0
    np.testing.assert_array_equal(found.depth_m > 0, measured)
    assert np.abs(found.depth_m - made.depth_m).max() < 1e-4
    assert np.abs(found.depth_sigma_m - made.depth_sigma_m)[measured].max() < 1e-4
    assert (found.depth_sigma_m[measured] > 0).all()


def test_frames_that_were_not_kept_are_the_same_and_broken_ones_are_told(tmp_path, monkeypatch) -> None:
    frames = [frame(n) for n in range(4)]
    kept, asked = opened(tmp_path, frames)
    for each in frames:
        kept.keep(each)
    whole = list(kept.frames(range(4)))
    assert not asked
    kept.clear()
    assert len(list(kept.frames(range(4)))) == 4
    assert asked == [0, 1, 2, 3], "from the capture again"
    free = shutil.disk_usage(tmp_path)._replace(free=2 * kept._bytes - 2)  # half of it holds all but the last
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: free)
    for most, expected in ((frame_cache._MOST_BYTES, [3, 4]), (0, [0, 1, 2, 3, 4])):
        monkeypatch.setattr(frame_cache, "_MOST_BYTES", most)
        full, also_asked = opened(tmp_path, frames)
        for each in frames:
            full.keep(each)
        *found, broken = full.frames([0, 1, 2, 3, 4])
        assert isinstance(broken, FrameError)
        assert also_asked == expected
        for a, b in zip(found, whole, strict=True):
            np.testing.assert_array_equal(a.color, b.color)
            np.testing.assert_array_equal(a.depth_m, b.depth_m)


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path) -> None:
    cache, asked = opened(tmp_path / "missing", [frame(0)])
    cache.keep(frame(0))
    (found,) = cache.frames([0])
    assert found.index == 0
    assert asked == [0]
