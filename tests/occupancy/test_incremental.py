"""Keyframes are added, removed and moved: the same map as from scratch, with only their blocks rebuilt."""

import numpy as np
import pytest
from scenes import lifted, posed, random_gaussians, wall_frame

from freeocc3d.core.types import Gaussians, Occupancy
from freeocc3d.core.voxel_keys import pack_voxels
from freeocc3d.gaussians import anchors
from freeocc3d.occupancy import build, carve, splat
from freeocc3d.occupancy.incremental import IncrementalOccupancy

ORIGIN = np.array([0.3, -0.2, 0.05])


def pose(x: float, angle: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[0, 3] = x
    return T


class Scene:
    """Walls seen one by one, each keyframe with its own Gaussians."""

    def __init__(self, count: int = 6) -> None:
        rng = np.random.default_rng(0)
        self.frames = [wall_frame(2.0 + 0.1 * n, n, seed=n) for n in range(count)]
        self.T = {n: pose(0.5 * n, 0.1 * n) for n in range(count)}
        self.gaussians = {n: lifted([self.frames[n]], [self.T[n]]) for n in range(count)}
        self.features = {n: rng.uniform(0.1, 1, (len(g), 4)).astype(np.float16) for n, g in self.gaussians.items()}
        self.map = IncrementalOccupancy(splat.Options(), carve.Options(), ORIGIN)

    def add(self, n: int) -> None:
        self.map.add(n, self.frames[n], self.T[n], self.gaussians[n], self.features[n])

    def move(self, n: int, T: np.ndarray) -> None:
        own = self.gaussians[n]
        self.gaussians[n] = anchors.reanchor(own, self.T[n][None], T[None])
        self.T[n] = T
        self.map.move(n, self.frames[n], T, self.gaussians[n])

    def from_scratch(self, numbers: list[int]) -> Occupancy:
        gaussians = Gaussians.concatenated([self.gaussians[n] for n in numbers])
        features = np.concatenate([self.features[n] for n in numbers])
        looks = posed([self.frames[n] for n in numbers], [self.T[n] for n in numbers])
        return build.build_occupancy(gaussians, features, looks, splat.Options(), carve.Options(), ORIGIN)


def assert_same(a: Occupancy, b: Occupancy) -> None:
    """But for blocks that say nothing."""
    says = (b.probability > 0).any(axis=1) | (b.free > 0).any(axis=1) | (b.hits > 0).any(axis=1)
    for name in ("keys", "probability", "free", "hits", "state"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name)[says], err_msg=name)
    np.testing.assert_array_equal(a.features, b.features)
    np.testing.assert_array_equal(a.colors, b.colors)


def test_added_removed_and_moved_keyframes_leave_what_a_full_pass_gives() -> None:
    scene = Scene()
    for n in (2, 0, 1):
        scene.add(n)
        scene.map.update()
    assert_same(scene.map.update(), scene.from_scratch([0, 1, 2]))
    scene.add(4)
    scene.add(3)
    assert_same(scene.map.update(), scene.from_scratch([0, 1, 2, 3, 4]))
    scene.map.remove(1, scene.frames[1])
    assert_same(scene.map.update(), scene.from_scratch([0, 2, 3, 4]))
    scene.move(3, pose(1.2, -0.3))
    found = scene.map.update()
    assert_same(found, scene.from_scratch([0, 2, 3, 4]))
    assert len(found.colors) > 500


def test_only_the_blocks_that_a_keyframe_touches_are_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    for n in range(5):
        scene.add(n)
    everything = scene.map.update()
    made = []
    monkeypatch.setattr(
        build, "build_blocks", lambda packed, *a, of=build.build_blocks: made.append(packed) or of(packed, *a)
    )
    scene.add(5)
    after = scene.map.update()
    assert len(made[0]) < 0.7 * len(everything.keys)
    before, now = (dict(zip(pack_voxels(o.keys).tolist(), o.probability, strict=True)) for o in (everything, after))
    for key in before.keys() - set(made[0].tolist()):
        np.testing.assert_array_equal(before[key], now[key])


def test_everything_removed_is_an_empty_map_and_numbers_are_unique() -> None:
    scene = Scene(2)
    scene.add(0)
    scene.add(1)
    with pytest.raises(ValueError, match="already added"):
        scene.add(1)
    scene.map.update()
    for n in (0, 1):
        scene.map.remove(n, scene.frames[n])
    empty = scene.map.update()
    assert len(empty.keys) == len(empty.colors) == 0
    with pytest.raises(ValueError, match="add a keyframe"):
        IncrementalOccupancy(splat.Options(), carve.Options()).update()
    with pytest.raises(KeyError):
        scene.map.remove(0, scene.frames[0])


def test_bins_of_some_blocks_are_those_of_all() -> None:
    bins = splat.bin_gaussians(random_gaussians(200, seed=1, extent=3.0), ORIGIN, splat.Options())
    some = bins.only(bins.packed[1::2])
    assert len(some.packed) == len(bins.packed[1::2])
    for row in range(len(some.packed)):
        whole = slice(bins.start[2 * row + 1], bins.start[2 * row + 2])
        np.testing.assert_array_equal(some.gaussian[some.start[row] : some.start[row + 1]], bins.gaussian[whole])
