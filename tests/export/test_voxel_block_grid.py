"""Maps as Open3D's VoxelBlockGrid, opened by Open3D itself and compared voxel by voxel."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import open3d as o3d
import open3d.core as o3c
import pytest
from exported_maps import map_of
from manifests import tiny_manifest
from scenes import lifted, occupancy_of, posed, wall_frame

from freeocc3d.core.errors import ConfigError, ExportError, FreeOccError
from freeocc3d.core.types import OCCUPIED, Occupancy
from freeocc3d.core.voxel_keys import pack_voxels
from freeocc3d.export import export_map, voxel_block_grid
from freeocc3d.export.voxel_block_grid import read_occupancy, write_grid
from freeocc3d.language.encoders.base import TextFeatures
from freeocc3d.language.feature_codec import Codec, CodedFeatures, compute_cosines
from freeocc3d.occupancy import build, carve, splat
from freeocc3d.storage.manifest import EncoderRecord

WORDS = ["cup", "table"]
DIMENSION = 60


def load(path: Any) -> Any:
    return o3d.t.geometry.VoxelBlockGrid.load(str(path))


@pytest.fixture(scope="module")
def wall() -> Occupancy:
    frames, poses = [wall_frame(2.0)], [np.eye(4)]
    g = lifted(frames, poses)
    rng = np.random.default_rng(0)
    features = (rng.uniform(0.1, 1, (len(g), 8)) @ rng.uniform(0.1, 1, (8, DIMENSION))).astype(np.float16)
    origin = np.array([0.5, -3.0, 0.01])
    return build.build_occupancy(g, features, posed(frames, poses), splat.Options(), carve.Options(), origin)


@pytest.fixture(scope="module")
def scan_map(wall: Occupancy) -> Any:
    """A map whose features are coded, with words that have features of their own."""
    text = np.random.default_rng(1).normal(size=(len(WORDS), DIMENSION)).astype(np.float32)
    text /= np.linalg.norm(text, axis=1, keepdims=True)
    codec = Codec.fit(wall.features)
    assert len(codec.basis) < DIMENSION  # the grid keeps fewer numbers than features have
    found = map_of(wall.replace(features=CodedFeatures(codec, codec.encode(wall.features))))
    found.vocabulary = WORDS
    found.manifest = tiny_manifest(encoder=EncoderRecord(name="clip", state={}))
    found.text_encoder = SimpleNamespace(
        threshold=0.3, encode_words=lambda words: TextFeatures(text, tuple(words), np.array((0.5, 1.0), np.float32))
    )
    return found


def test_open3d_opens_what_is_exported_and_no_voxel_differs(scan_map: Any, wall: Occupancy, tmp_path) -> None:
    export_map(scan_map, "voxel_block_grid", tmp_path / "grid.npz")
    grid = load(tmp_path / "grid.npz")
    coordinates, index = (values.numpy() for values in grid.voxel_coordinates_and_flattened_indices())
    with np.load(tmp_path / "grid.npz") as file:
        beside = {name: file[name] for name in file.files if not name.startswith("value_")}
    voxels = np.rint(coordinates / wall.voxel_size).astype(int)
    block = {tuple(key): row for row, key in enumerate(wall.keys.tolist())}
    rows = np.array([block[tuple(key)] for key in (voxels >> 3).tolist()])
    i, j, k = (voxels & 7).T
    local = (i * 8 + j) * 8 + k
    assert len(np.unique(rows * 512 + local)) == wall.state.size

    def value(name: str) -> Any:
        values = grid.attribute(name)
        return values.reshape((-1, values.shape[-1])).numpy()[index]

    for name in ("probability", "free", "hits", "state"):
        stored = getattr(wall, name)
        assert value(name).dtype == stored.dtype
        np.testing.assert_array_equal(value(name)[:, 0], stored[rows, local], err_msg=name)
    of_occupied = np.full(wall.state.shape, -1)
    of_occupied[wall.state == OCCUPIED] = np.arange(len(wall.colors))
    own = of_occupied[rows, local]
    np.testing.assert_array_equal(value("color")[own >= 0], wall.colors[own[own >= 0]])
    assert not value("color")[own < 0].any()
    assert not value("feature")[own < 0].any()
    features = value("feature")[own >= 0]
    np.testing.assert_allclose(np.linalg.norm(features, axis=1), 1, atol=1e-5)
    text = scan_map.text_encoder.encode_words(WORDS).features
    expected = compute_cosines(scan_map.occupancy.features, text)[own[own >= 0]]
    np.testing.assert_allclose(features @ (beside["feature_basis"] @ text.T), expected, atol=2e-3)
    np.testing.assert_allclose(features @ beside["word_features"].T, expected, atol=2e-3)
    assert beside["words"].tobytes().decode().split("\n") == WORDS
    assert beside["word_attainable"].tolist() == [0.5, 1.0]
    np.testing.assert_array_equal(beside["origin"], wall.origin)
    np.testing.assert_array_equal(beside["T_world_map"], np.eye(4))
    described = json.loads((tmp_path / "grid.npz.json").read_text())
    assert (described["encoder"], described["threshold"], described["frame"]) == ("clip", 0.3, "map")


def test_features_can_be_left_out_and_other_frames_are_sampled_anew(scan_map: Any, tmp_path) -> None:
    export_map(scan_map, "voxel_block_grid", tmp_path / "plain.npz", {"features": False})
    plain = load(tmp_path / "plain.npz")
    assert plain.attribute("color").shape[-1] == 3
    with np.load(tmp_path / "plain.npz") as file:
        assert {"origin", "T_world_map"} <= set(file.files)
        assert not {"feature_basis", "words", "attr_name_feature"} & set(file.files)
    export_map(scan_map, "voxel_block_grid", tmp_path / "level.npz", {"frame": "gravity"})
    level = load(tmp_path / "level.npz")
    state = level.attribute("state").numpy()
    features = level.attribute("feature").numpy()[state[..., 0] == OCCUPIED]
    assert len(features) > 100
    np.testing.assert_allclose(np.linalg.norm(features, axis=1), 1, atol=1e-5)


def test_there_and_back_nothing_is_lost(wall: Occupancy, tmp_path) -> None:
    write_grid(tmp_path / "grid.npz", wall, wall.features)
    grid = load(tmp_path / "grid.npz")
    assert len(grid.hashmap().active_buf_indices()) == len(wall.keys)
    read = read_occupancy(grid, wall.voxel_size, wall.origin)
    for name in ("keys", "probability", "free", "hits", "state", "colors", "origin"):
        np.testing.assert_array_equal(getattr(read, name), getattr(wall, name), err_msg=name)
    np.testing.assert_allclose(read.features, wall.features, atol=1e-3)


def test_open3d_places_voxels_where_they_are(wall: Occupancy, tmp_path) -> None:
    write_grid(tmp_path / "grid.npz", wall)
    grid = load(tmp_path / "grid.npz")
    coordinates, index = grid.voxel_coordinates_and_flattened_indices()
    state = grid.attribute("state").reshape((-1,)).numpy()[index.numpy()]
    theirs = coordinates.numpy()[state == OCCUPIED] + wall.origin + 0.5 * wall.voxel_size
    ours = wall.centers(wall.occupied_voxels())
    assert len(theirs) == len(ours) > 100
    np.testing.assert_allclose(theirs[np.lexsort(theirs.round(3).T)], ours[np.lexsort(ours.round(3).T)], atol=1e-5)


def test_blocks_of_sixteen_are_cut() -> None:
    attributes = ("probability", "state"), (o3c.float32, o3c.uint8), ((1,), (1,))
    grid = o3d.t.geometry.VoxelBlockGrid(*attributes, 0.05, 16, 4, o3c.Device("cpu:0"))
    rows, _ = grid.hashmap().activate(o3c.Tensor(np.array([[-1, 0, 2]], np.int32)))
    state = np.zeros((1, 16, 16, 16, 1), np.uint8)
    state[0, 3, 9, 14] = OCCUPIED  # z, y, x
    grid.attribute("state")[rows.to(o3c.int64)] = o3c.Tensor(state)
    occupancy = read_occupancy(grid, 0.05)
    assert len(occupancy.keys) == 8
    assert (np.diff(pack_voxels(occupancy.keys)) > 0).all()
    np.testing.assert_array_equal(occupancy.occupied_voxels(), [[-16 + 14, 9, 32 + 3]])


def test_what_is_no_grid_of_occupancy_and_what_fits_no_grid(tmp_path, monkeypatch) -> None:
    tsdf = o3d.t.geometry.VoxelBlockGrid(("tsdf",), (o3c.float32,), ((1,),), 0.05, 8, 4, o3c.Device("cpu:0"))
    with pytest.raises(FreeOccError, match="holds no occupancy"):
        read_occupancy(tsdf, 0.05)
    small = occupancy_of([(0, 0, 0), (9, 0, 0)])
    with pytest.raises(ExportError, match="one size"):
        write_grid(tmp_path / "grid.npz", small.replace(levels=np.array((0, 1), np.uint8)))
    with pytest.raises(ConfigError, match=r"\.npz"):
        export_map(map_of(small), "voxel_block_grid", tmp_path / "grid.vbg")
    monkeypatch.setattr(voxel_block_grid, "_LARGEST_ATTRIBUTE", 5000)
    with pytest.raises(ExportError, match="'feature' takes more than 2 GiB"):
        write_grid(tmp_path / "grid.npz", small, small.features)
