"""Given poses: depth from a point cloud, and the scale that depth tells, each against plain computations."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from freeocc3d.core.errors import TrackingError
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.tracking.trackers import file, known

CAMERA = Intrinsics(37, 21, 30.0, 26.0, 17.0, 11.0)


def test_the_nearest_point_of_a_pixel_wins_and_those_far_behind_others_nearby_are_hidden() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -1.5, -0.5), (2, 1.5, 4), (900, 3)).astype(np.float32)
    points[:5, 2] = 0.04, 0.051, 0.2, 0.3, 0.06
    points[:5, :2] = 0
    frame = Frame(0, 0.0, np.zeros((21, 37, 3), np.uint8), np.zeros((21, 37), np.float32), CAMERA)
    places = []
    for x, y, z in points.astype(float):
        u, v = round(x / z * 30 + 17), round(y / z * 26 + 11)
        if z > 0.05 and 0 <= u < 37 and 0 <= v < 21:
            places.append((v, u, z))
    wanted = np.zeros((21, 37))
    for v, u, z in places:
        nearest = min(depth for row, column, depth in places if (row // 8, column // 8) == (v // 8, u // 8))
        if z <= 1.05 * nearest and (wanted[v, u] == 0 or z < wanted[v, u]):
            wanted[v, u] = z
    assert np.count_nonzero(wanted) > 15
    np.testing.assert_allclose(file.project_depth(points, frame), wanted, rtol=1e-6)


def test_a_cloud_fills_only_what_has_no_depth() -> None:
    T = np.tile(np.eye(4), (2, 1, 1))
    T[0, :3, 3] = 0, 0, -1
    T[1] = np.nan
    tracker = file.FileTracker(T, 0.8, np.float32([(0, 0, 2), (0.5, 0, 2)]))
    assert tracker.brings_depth
    assert not file.FileTracker(T, 0.8).brings_depth
    depth = np.zeros((21, 37), np.float32)
    depth[11, 17] = 1.5
    frame = Frame(0, 0.0, np.zeros((21, 37, 3), np.uint8), depth, CAMERA)
    made = tracker.prepare_frame(frame).depth_m
    assert made[11, 17] == 1.5
    assert made[11, 22] == 3.0
    assert np.count_nonzero(made) == 2
    lost = Frame(1, 1.0, frame.color, depth, CAMERA)
    assert tracker.prepare_frame(lost) is lost


def pair_scale(monkeypatch, count=30, wrong=0, step=0.5, scale=2.0, frames=2, missing=(), by=0.9) -> float | None:
    """The scale from matches of two frames, ``step`` units apart, at depths of about 4 m; ``wrong`` of the matches lie
    elsewhere, by a part of the motion. Of more frames, only those that are not missing can be read."""
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (max(frames, 2), 1, 1))
    T[:, :3, :3] = ((0.8, 0.0, 0.6), (0.0, 1.0, 0.0), (-0.6, 0.0, 0.8))
    T[1:, 0, 3] = step
    p_s = rng.uniform((-1, -1, 3), (1, 1, 5), (count, 3))
    T_ts = np.linalg.inv(T[0]) @ T[1]
    p_t = p_s @ T_ts[:3, :3].T + scale * T_ts[:3, 3]
    p_t[count - wrong :] += (0.0, by * scale * step, 0.0)
    unknown = np.concatenate((p_s, np.zeros((5, 3))))  # features without depth
    decoded = []

    def decode(capture, index):
        decoded.append(index)
        return None if index in missing else SimpleNamespace(features=index, points=unknown if index else p_t_known)

    p_t_known = np.concatenate((p_t, np.ones((5, 3))))
    rows = np.stack([np.arange(count + 5)] * 2, axis=1)
    monkeypatch.setattr(file, "decode_keyframe_view", decode)
    monkeypatch.setattr(file.orb_features, "match_binary", lambda a, b: rows)
    found = file._pair_scale(T, None, np.arange(frames))  # type: ignore[arg-type]
    pair_scale.decoded = decoded  # type: ignore[attr-defined]
    return found


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({}, True),
        ({"count": 20}, True),
        ({"count": 19}, False),
        ({"wrong": 14}, True),
        ({"wrong": 15}, False),
        ({"wrong": 15, "by": 0.49}, True),  # within half of the motion
        ({"wrong": 15, "by": 0.51}, False),
        ({"step": 0.0}, False),
        ({"scale": -2.0}, False),
        ({"step": 0.11}, True),  # 0.22 m at 4 m
        ({"step": 0.08}, False),
    ],
)
def test_a_pair_gives_a_scale_if_its_matches_agree(monkeypatch, changes: dict, found: bool) -> None:
    scale = pair_scale(monkeypatch, **changes)
    assert (scale is not None) == found
    if found:
        assert scale == pytest.approx(2.0)


def test_the_farthest_frames_are_tried_first(monkeypatch) -> None:
    assert pair_scale(monkeypatch, frames=13) == pytest.approx(2.0)
    assert pair_scale.decoded == [0, 12]  # type: ignore[attr-defined]
    assert pair_scale(monkeypatch, frames=13, missing=(12, 6)) == pytest.approx(2.0)
    assert pair_scale.decoded == [0, 12, 6, 3]  # type: ignore[attr-defined]
    assert pair_scale(monkeypatch, missing=(0,)) is None


@pytest.mark.parametrize(("pairs", "found"), [(5, None), (6, 3.0)])
def test_six_pairs_give_a_scale(monkeypatch, pairs: int, found: float | None) -> None:
    told = iter([3.0] * (pairs - 1) + [9.0] + [None] * 99)
    monkeypatch.setattr(file, "_pair_scale", lambda *_: next(told))
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[::3] = np.nan
    assert file.estimate_depth_scale(poses, None) == found  # type: ignore[arg-type]
    assert file.estimate_depth_scale(poses[:2], None) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("measured", "given", "found"),
    [(None, 1.0, 1.0), (2.5, 1.0, 1.0), (2.5, None, 2.5), (None, None, None)],
)
def test_the_scale_is_stated_or_comes_from_depth(monkeypatch, measured, given, found) -> None:
    monkeypatch.setattr(file, "estimate_depth_scale", lambda T, capture: measured)
    capture = SimpleNamespace(has_depth=True, path=Path("scan"))
    options = file.Options(path="t.txt", scale=given)
    if found is None:
        with pytest.raises(TrackingError, match=r"tracking\.file\.scale"):
            file._scale(np.zeros((0, 4, 4)), capture, options)  # type: ignore[arg-type]
    else:
        assert file._scale(np.zeros((0, 4, 4)), capture, options) == found  # type: ignore[arg-type]


@pytest.mark.parametrize(("own", "given", "found"), [(None, None, 1.0), (None, 2.0, 2.0), (3.0, 2.0, 3.0)])
def test_without_depth_the_captures_scale_comes_first(own, given, found: float) -> None:
    capture = SimpleNamespace(has_depth=False, options=SimpleNamespace(scale=own))
    options = file.Options(path="t.txt", scale=given)
    assert file._scale(np.zeros((0, 4, 4)), capture, options) == found  # type: ignore[arg-type]


def test_known_poses_are_the_captures_and_none_is_an_error() -> None:
    class Scan:
        path, metric_poses = Path("scan"), False

        def __init__(self, poses) -> None:
            self.poses = poses

        def __len__(self) -> int:
            return len(self.poses)

        def pose(self, index: int):
            return self.poses[index]

    tracker = known.load(known.Options(keyframe_overlap=0.6), Scan([None, 2 * np.eye(4)]))  # type: ignore[arg-type]
    assert np.isnan(tracker.T_world_cam[0]).all()
    np.testing.assert_array_equal(tracker.T_world_cam[1], 2 * np.eye(4))
    assert (tracker.metric, tracker.keyframe_overlap) == (False, 0.6)
    with pytest.raises(TrackingError, match="has no poses"):
        known.load(known.Options(), Scan([None, None]))  # type: ignore[arg-type]
