"""Smaller voxels only where they show more: the built-in room with its two cups."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import refused, run
from scenes import lifted, posed, wall_frame

from freeocc3d import load_map
from freeocc3d.capture.builtin.builtin_room import CUP_HEIGHT, CUPS
from freeocc3d.core import voxel_keys
from freeocc3d.core.errors import ConfigError, MapError
from freeocc3d.core.transforms import invert, transform
from freeocc3d.core.types import FREE, OCCUPIED, Gaussians
from freeocc3d.editing import adaptive_voxels
from freeocc3d.export import export_map
from freeocc3d.occupancy import build, carve, splat
from freeocc3d.occupancy.connected_components import label_components
from freeocc3d.pipeline import checks
from freeocc3d.pipeline import run as pipeline
from freeocc3d.query.scan_map import Map
from freeocc3d.settings import config
from freeocc3d.viewer.map_pictures import write_map_picture

RED, YELLOW = (np.array(CUPS[name]) + (0, 0, 0.5 * CUP_HEIGHT) for name in ("red", "yellow"))


SETTINGS = {
    "capture": {"stride": 8, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}},
    "tracking": {"backend": "known"},
    "fitting": {"passes": 0},
}


@pytest.fixture(scope="module", autouse=True)
def _in_the_maps_frame(room: Map) -> None:
    """Moves the places of the cups into the frame of the room's map."""
    for place in (RED, YELLOW):
        place[:] = transform(invert(np.array(room.manifest.T_world_map)), place)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Map:
    return pipeline.reconstruct("builtin:room", tmp_path_factory.mktemp("adaptive") / "room", SETTINGS)


@pytest.fixture(scope="module")
def fine(room: Map, tmp_path_factory) -> Map:
    return adaptive_voxels.refine_where_needed(room, 0.01, tmp_path_factory.mktemp("adaptive") / "fine")


def flat(n: int, z: float = 0.0, depth: float = 1.0) -> Gaussians:
    """Gaussians 4 cm apart on a square in the plane of that height, seen from so far."""
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    means = np.stack((0.04 * x.ravel() + 0.02, 0.04 * y.ravel() + 0.02, np.full(n * n, z + 0.01)), axis=1)
    return Gaussians(
        means=means.astype(np.float32),
        scales=np.full((n * n, 3), 0.028, np.float32),
        quats_wxyz=np.tile(np.array((1, 0, 0, 0), np.float32), (n * n, 1)),
        opacities=np.full(n * n, 0.9, np.float32),
        colors=np.zeros((n * n, 3), np.uint8),
        anchor_keyframe=np.zeros(n * n, np.int32),
        anchor_cam=np.full((n * n, 3), depth, np.float32),
    )


def detailed(gaussians: Gaussians, features: np.ndarray) -> list[tuple[int, ...]]:
    """Keys of the blocks of 8 cm voxels that would be cut."""
    changing = adaptive_voxels._changing(gaussians.means, features)
    everywhere = voxel_keys.pack_voxels(
        np.array([(i, j, k) for i in range(-1, 3) for j in range(-1, 3) for k in range(-1, 2)])
    )
    found = adaptive_voxels._detailed(np.sort(everywhere), gaussians, changing, np.zeros(3), 0.08)
    return [tuple(key) for key in voxel_keys.unpack_voxels(found).tolist()]


def test_a_wall_of_one_kind_is_left_alone_wherever_it_leans() -> None:
    wall = flat(32)
    alike = np.tile(np.array((1, 0), np.float16), (len(wall), 1))
    assert detailed(wall, alike) == []
    leaning = wall.means.copy()
    leaning[:, 2] = 0.5 * leaning[:, 0]
    assert detailed(Gaussians(leaning, *list(vars(wall).values())[1:]), alike) == []


def test_a_step_a_change_of_meaning_and_neither_where_it_is_noise() -> None:
    wall = flat(32)
    alike = np.tile(np.array((1, 0), np.float16), (len(wall), 1))
    step = wall.means.copy()
    step[(step[:, 0] > 1.04), 2] += 0.06
    stepped = [*list(vars(wall).values())[1:]]
    assert {key[0] for key in detailed(Gaussians(step, *stepped), alike)} == {1}
    far = flat(32, depth=5.0)  # a depth is uncertain by 4 cm there
    assert detailed(Gaussians(step, *list(vars(far).values())[1:]), alike) == []
    other = alike.copy()
    other[wall.means[:, 1] < 0.3] = (0, 1)
    assert {key[1] for key in detailed(wall, other)} == {0}
    other[wall.means[:, 1] < 0.3] = 0  # nothing is known there
    assert detailed(wall, other) == []


def test_down_to_the_finest_only_along_the_line_where_the_meaning_changes() -> None:
    """A flat wall at half a meter, of two kinds: small voxels lie along the line between them, at every level."""
    frames, poses = [wall_frame(0.5, n) for n in range(2)], np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.3
    settings = config.resolve({})

    def kinds(gaussians: Gaussians) -> np.ndarray:
        return np.eye(2, dtype=np.float16)[(gaussians.means[:, 0] < 0.1).astype(int)]

    wall = lifted(frames, poses, 0.04)
    base = build.build_occupancy(
        wall, kinds(wall), posed(frames, poses), splat.Options(), carve.Options(), origin=np.array((0, 0, 0.013))
    )
    made = adaptive_voxels.build_adaptive(
        base,
        wall,
        kinds(wall),
        lambda: iter(posed(frames, poses)),
        poses,
        kinds,
        settings,
        0.01,
        adaptive_voxels.Progress(),
    )
    assert made.deepest == 3
    centers = made.centers(made.occupied_voxels(), made.occupied_edges())
    finest = made.occupied_edges() == 1
    off = np.abs(centers[:, 0] - 0.1)
    assert off[finest].max() < 0.16  # a block of 8 cm beside the line, and a Gaussian of 4 cm
    assert (off[~finest & (np.abs(centers[:, 1]) < 0.15)] > 0.02).all()
    assert {1, 2, 4} <= set(made.occupied_edges())


def test_points_near_blocks() -> None:
    region = adaptive_voxels.Blocks(
        voxel_keys.pack_voxels(np.array([(0, 0, 0), (-1, 2, 0)])), np.array((1.0, 0, 0)), 0.5
    )
    points = np.array([(1.1, 0.1, 0.1), (0.9, 1.2, 0.3), (1.55, 0.2, 0.2), (1.7, 0.2, 0.2), (0.8, 0.2, 0.2)])
    np.testing.assert_array_equal(region.contains(points, 0.0), [True, True, False, False, False])
    np.testing.assert_array_equal(region.contains(points, 0.1), [True, True, True, False, False])
    np.testing.assert_array_equal(region.contains(points, 0.21), [True, True, True, True, True])


@pytest.mark.parametrize("margin", [0.0, 0.2, 0.5])
def test_near_blocks_is_within_the_margin_of_a_cube_along_all_axes(margin: float) -> None:
    rng = np.random.default_rng(0)
    origin, edge = np.array((0.3, -0.2, 0.1)), 0.25
    corners = np.unique(rng.integers(-3, 3, (40, 3)), axis=0)
    points = origin + rng.uniform(-0.8, 0.8, (500, 3))
    local = ((points - origin) / edge)[:, None]
    expected = ((local >= corners - margin) & (local <= corners + 1 + margin)).all(axis=2).any(axis=1)
    found = adaptive_voxels.Blocks(voxel_keys.pack_voxels(corners), origin, edge).contains(points, margin * edge)
    np.testing.assert_array_equal(found, expected)
    assert 20 < found.sum() < 480


def test_sizes_that_halving_reaches() -> None:
    assert adaptive_voxels.count_halvings(0.08, 0.08) == 0
    assert adaptive_voxels.count_halvings(0.08, 0.005) == 4
    for finest in (0.03, 0.16, 0.0, -1.0, 0.08 / 2**9):
        with pytest.raises(MapError, match="possible smallest sizes"):
            adaptive_voxels.count_halvings(0.08, finest)


def test_no_space_is_claimed_twice_and_none_is_lost(room: Map, fine: Map) -> None:
    """Every block of the coarse map is there, whole or in parts, and nothing else."""
    made = fine.occupancy
    assert made.deepest == 3
    seen: set[tuple[int, ...]] = set()
    for key, level in zip(made.keys.tolist(), made.levels.tolist(), strict=True):
        ancestors = [(up, *np.right_shift(key, level - up).tolist()) for up in range(level)]
        assert not seen & set(ancestors)
        assert ancestors == [] or ancestors[0][1:] in set(map(tuple, room.occupancy.keys.tolist()))
        seen.add((level, *key))
    assert len(seen) == len(made.keys)


def test_flat_walls_stay_coarse_and_things_become_fine(room: Map, fine: Map) -> None:
    made = fine.occupancy
    share = np.bincount(made.levels, (made.state == OCCUPIED).sum(axis=1) * 0.25**made.levels)
    assert share[0] > 0.05 * share.sum()  # of the surface, by area: blocks of 64 cm hold more than a wall
    centers, edges = made.centers(made.occupied_voxels(), made.occupied_edges()), made.occupied_edges()
    for cup in (RED, YELLOW):
        near = np.linalg.norm(centers - cup, axis=1) < 0.06
        assert (edges[near] == 1).mean() > 0.6
    blocks_of_finest = (8.0 ** (3 - made.levels)).sum()
    assert len(made.levels) < 0.5 * blocks_of_finest


def test_cups_that_were_one_lump_are_two_in_the_map_of_the_room(fine: Map) -> None:
    made = fine.occupancy
    corners, edges = made.occupied_voxels(), made.occupied_edges()
    centers = made.centers(corners, edges)
    above_table = (np.linalg.norm(centers - 0.5 * (RED + YELLOW), axis=1) < 0.2) & (centers[:, 2] > 0.77)
    component = label_components(corners[above_table], edges[above_table])
    middles = [centers[above_table][component == c].mean(axis=0) for c in np.unique(component)]
    sizes = np.bincount(component)
    large = [middle for middle, size in zip(middles, sizes, strict=True) if size > 30]
    assert len(large) == 2
    for cup in (RED, YELLOW):
        assert min(np.linalg.norm(middle[:2] - cup[:2]) for middle in large) < 0.02
    for word, cup in (("red", RED), ("yellow", YELLOW)):
        regions = fine.query(word, top_k=200).regions
        assert min(np.linalg.norm(region.centroid[:2] - cup[:2]) for region in regions) < 0.02
    free = made.centers(made.voxels(FREE), made.edges(FREE))
    assert np.linalg.norm(free - 0.5 * (RED + YELLOW), axis=1).min() < 0.02


def test_saved_loaded_exported_and_drawn(room: Map, fine: Map, tmp_path: Path) -> None:
    again = load_map(fine.path)
    assert again.manifest.format_version == 3
    assert room.manifest.format_version == 2
    np.testing.assert_array_equal(again.occupancy.levels, fine.occupancy.levels)
    assert len(again.keyframes) == len(room.keyframes)
    export_map(again, "ply", tmp_path / "map.ply")
    export_map(again, "npz", tmp_path / "sparse.npz", {"form": "sparse"})
    sparse = np.load(tmp_path / "sparse.npz")
    assert sparse["voxel_size"] == 0.01
    assert set(np.unique(sparse["edges"])) == {1, 2, 4, 8}
    volume = (sparse["edges"][sparse["state"] == OCCUPIED].astype(float) ** 3).sum()
    assert volume == (again.occupancy.occupied_edges().astype(float) ** 3).sum()
    write_map_picture(again, tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 20_000
    facts = json.loads(run("info", fine.path, "--json").stdout)
    assert facts["voxel_size_m"] == 0.08
    assert facts["finest_voxel_m"] == 0.01
    told = run("info", fine.path).stdout
    assert "edges 0.08 to 0.01 m" in told
    assert f"from {room.path}" in told


def test_as_an_option_of_reconstruct_it_is_the_same_map(tmp_path: Path) -> None:
    part = {**SETTINGS["capture"], "stop": 24}
    settings = {**SETTINGS, "capture": part}
    room = pipeline.reconstruct("builtin:room", tmp_path / "room", settings)
    made = pipeline.reconstruct("builtin:room", tmp_path / "at_once", {**settings, "occupancy": {"finest": 0.02}})
    later = adaptive_voxels.refine_where_needed(room, 0.02, tmp_path / "later")
    np.testing.assert_array_equal(made.occupancy.keys, later.occupancy.keys)
    agree = made.occupancy.state == later.occupancy.state
    assert agree.mean() > 0.999  # features decide where to look; a saved map's are coded
    with pytest.raises((ConfigError, MapError), match="Halving voxels of"):
        checks.check(config.resolve({"occupancy": {"finest": 0.03}}))


def test_what_cannot_be_refined(room: Map, fine: Map, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="already has voxels of several sizes"):
        adaptive_voxels.refine_where_needed(fine, 0.005, tmp_path / "map")
    with pytest.raises(MapError, match="already"):
        adaptive_voxels.refine_where_needed(room, 0.08, tmp_path / "map")
    with pytest.raises(MapError, match="cannot replace it"):
        adaptive_voxels.refine_where_needed(room, 0.04, room.path, overwrite=True)
    assert "Halving voxels of" in refused("refine", room.path, "--voxel", 0.03, "-o", tmp_path / "map")
    assert not list(tmp_path.iterdir())


def test_faces_of_two_sizes() -> None:
    from freeocc3d.occupancy.surface_faces import build_faces

    corners, quads, rows = build_faces(np.array([(0, 0, 0), (2, 0, 0)]), np.array([2, 1]))
    assert np.bincount(rows).tolist() == [6, 5]  # the small cube's face on the large one is hidden, not the other way
    assert corners.max(axis=0).tolist() == [3, 2, 2]
    assert len(quads) == 11


def test_components_of_two_sizes_agree_with_plain_boxes() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        large = 4 * rng.integers(-3, 3, (6, 3))
        small = rng.integers(-12, 12, (40, 3))
        small = small[~((small[:, None] >= large) & (small[:, None] < large + 4)).all(axis=2).any(axis=1)]
        corners = np.concatenate((np.unique(large, axis=0), np.unique(small, axis=0)))
        edges = np.concatenate((np.full(len(np.unique(large, axis=0)), 4), np.ones(len(np.unique(small, axis=0)), int)))
        ends = corners + edges[:, None]
        touch = ((corners[:, None] <= ends) & (corners <= ends[:, None])).all(axis=2)
        while (more := touch.astype(int) @ touch > 0).sum() > touch.sum():
            touch = more
        found = label_components(corners.astype(np.int32), edges.astype(np.int32))
        np.testing.assert_array_equal(found[:, None] == found, touch)
