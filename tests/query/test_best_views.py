"""The keyframes that show a region: a thing in front of a wall, seen and hidden."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scenes import CAMERA
from worded_voxels import WORDS, box, feature, occupancy

from freeocc3d.core.types import Frame, Trajectory
from freeocc3d.query.best_views import best_views
from freeocc3d.query.word_query import query
from freeocc3d.storage.keyframes import Keyframes

LOW, HIGH = np.array((-0.2, -0.2, 2.0)), np.array((0.2, 0.2, 2.4))
"""The thing, in the map's frame, whose z the cameras look along."""


def seen_from(z: float, hidden: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the thing's front and of a wall at z = 3 from a camera at (0, 0, z), and the pose. hidden: something at
    half the way hides the thing."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    front = LOW[2] - z
    x, y = (u - CAMERA.cx) / CAMERA.fx * front, (v - CAMERA.cy) / CAMERA.fy * front
    depth = np.where((np.abs(x) < 0.2) & (np.abs(y) < 0.2), front / 2 if hidden else front, 3.0 - z)
    T = np.eye(4)
    T[2, 3] = z
    return depth.astype(np.float32), T


def keyframes(folder: Path, looks: list[tuple[np.ndarray, np.ndarray]]) -> tuple[Trajectory, Keyframes]:
    """Keyframes that are every third frame of a capture."""
    made = Keyframes(folder)
    T = np.full((3 * len(looks), 4, 4), np.nan)
    for row, (depth, pose) in enumerate(looks):
        color = np.zeros((*depth.shape, 3), np.uint8)
        made.append(Frame(3 * row, float(row), color, depth, CAMERA))
        T[3 * row] = pose
    n = len(T)
    rows = np.arange(0, n, 3, dtype=np.int32)
    return Trajectory(np.arange(n, dtype=float), T, rows, np.full(n, "tracked"), np.ones(n, np.float32)), made


def test_the_nearest_of_those_that_see_it_alike_comes_first_and_hidden_ones_do_not_come(tmp_path: Path) -> None:
    room = occupancy(box((-2, -2, 20), (2, 2, 21), feature(CUP=1)))
    regions = query(room, WORDS, ["cup"])[0].regions
    away = seen_from(0.0)[0], np.diag((-1.0, 1.0, -1.0, 1.0))
    looks = [seen_from(-1.0), seen_from(0.5), seen_from(0.8, hidden=True), away, seen_from(0.0), seen_from(0.2)]
    (views,) = best_views(room, *keyframes(tmp_path, looks), regions)
    assert [view.frame for view in views] == [3, 15, 12]
    assert [view.visible for view in views] == [1.0, 1.0, 1.0]
    for view, z in zip(views, (0.5, 0.2, 0.0), strict=True):
        depth = 2.05 - z  # of the voxels' centers
        x0, y0, x1, y1 = view.box
        assert abs(x0 - (CAMERA.cx - 0.2 / depth * CAMERA.fx)) <= 1
        assert abs(x1 - (CAMERA.cx + 0.2 / depth * CAMERA.fx)) <= 1
        assert abs(y0 - (CAMERA.cy - 0.2 / depth * CAMERA.fy)) <= 1
        assert abs(y1 - (CAMERA.cy + 0.2 / depth * CAMERA.fy)) <= 1


def test_what_lies_behind_the_surface_or_beyond_the_image_is_not_visible(tmp_path: Path) -> None:
    room = occupancy(box((-2, -2, 20), (2, 2, 24), feature(CUP=1)))
    regions = query(room, WORDS, ["cup"])[0].regions
    depth, T = seen_from(0.0)
    aside = T.copy()
    aside[0, 3] = 2.05 * (CAMERA.width / 2) / CAMERA.fx  # the thing's middle is on the left edge
    columns = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx * 2.0 + aside[0, 3]
    depth_aside = np.where(np.abs(columns) < 0.3, 2.0, 3.0)[None].repeat(CAMERA.height, 0).astype(np.float32)
    (views,) = best_views(room, *keyframes(tmp_path, [(depth, T), (depth_aside, aside)]), regions)
    assert views[0].frame == 0
    assert views[0].visible == 0.25  # one layer of four: the next one's centers lie 0.15 m behind the front
    assert views[1].visible == 0.125
    assert views[1].box[0] == 0


def test_a_keyframe_without_depth_or_a_map_without_keyframes_shows_nothing(tmp_path: Path) -> None:
    room = occupancy(box((-2, -2, 20), (2, 2, 21), feature(CUP=1)))
    regions = query(room, WORDS, ["cup"])[0].regions
    depth, T = seen_from(0.0)
    assert best_views(room, *keyframes(tmp_path / "a", [(0 * depth, T)]), regions) == [[]]
    assert best_views(room, *keyframes(tmp_path / "b", []), regions) == [[]]
