"""Signed distances against brute force."""

import numpy as np
import pytest
from exported_maps import VDB_READERS, map_of
from scenes import occupancy_of

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.export import esdf, export_map
from freeocc3d.export.export_frames import place_voxels


def scene():
    rng = np.random.default_rng(1)
    block = [(i, j, k) for i in range(3, 6) for j in range(2, 5) for k in range(4)]
    dots = [tuple(v) for v in rng.integers(0, 10, (6, 3)).tolist()]
    occupied = sorted({*block, *dots})
    free = [v for v in np.ndindex(10, 9, 8) if v not in set(occupied) and sum(v) % 5]
    return occupancy_of(occupied, free=free, origin=(0.5, -1.0, 2.0))


def brute(obstacle, size):
    at = np.argwhere(np.ones(obstacle.shape, bool))
    inside = obstacle[tuple(at.T)]
    out = np.zeros(len(at))
    for row, point in enumerate(at):
        other = at[inside != inside[row]]
        nearest = np.sqrt(((other - point) ** 2).sum(axis=1).min()) - 0.5
        out[row] = size * (-nearest if inside[row] else nearest)
    return out.reshape(obstacle.shape)


@pytest.mark.parametrize("unknown", ["free", "obstacle", "nan"])
def test_distances_are_exact_and_in_meters(tmp_path, unknown) -> None:
    export_map(map_of(scene()), "esdf", tmp_path / "esdf.npz", {"frame": "map", "unknown": unknown})
    with np.load(tmp_path / "esdf.npz") as file:
        distance, state = file["distance"], file["state"]
        np.testing.assert_allclose(file["origin"], (0.5, -1.0, 2.0))
        assert distance.dtype == np.float32
    expected = brute(state != 0 if unknown == "obstacle" else state == 1, 0.1)
    if unknown == "nan":
        expected[state == 255] = np.nan
    np.testing.assert_allclose(distance, expected, atol=1e-6)
    assert (distance[state == 1] < 0).all()
    assert (state == 255).any()


def test_in_another_frame_the_arrays_say_where_they_are(tmp_path) -> None:
    scan_map = map_of(scene())
    export_map(scan_map, "esdf", tmp_path / "esdf.npz")
    there = place_voxels(scan_map, "gravity").occupancy
    with np.load(tmp_path / "esdf.npz") as file:
        at = np.argwhere(file["state"] == 1)
        found = file["origin"] + (at + 0.5) * float(file["voxel_size"])
        np.testing.assert_allclose(file["T_frame_map"], scan_map.T_gravity_map)
        assert str(file["frame"]) == "gravity"
    expected = there.centers(there.occupied_voxels())
    np.testing.assert_allclose(sorted(found.tolist()), sorted(expected.tolist()), atol=1e-6)


@pytest.mark.parametrize("read_vdb", VDB_READERS)
def test_openvdb_holds_the_distances_of_known_voxels(tmp_path, read_vdb) -> None:
    scan_map = map_of(scene())
    export_map(scan_map, "esdf", tmp_path / "esdf.npz")
    export_map(scan_map, "esdf", tmp_path / "esdf.vdb")
    with np.load(tmp_path / "esdf.npz") as file:
        distance, state, origin, size = (file[name] for name in ("distance", "state", "origin", "voxel_size"))
    at = np.argwhere(np.ones(state.shape, bool))
    shift = np.rint((origin - (0, 0, -0.05)) / size).astype(int)
    told = read_vdb(tmp_path / "esdf.vdb", at + shift, tmp_path)
    found, active = map(np.array, zip(*told["values"], strict=True))
    np.testing.assert_array_equal(active, (state != 255).ravel())
    np.testing.assert_array_equal(found, np.where(state != 255, distance, 0).ravel())
    np.testing.assert_allclose(told["world"][0], (0.05, 0.05, 0.0), atol=1e-12)
    assert told["metadata"]["frame"] == '"gravity"'


def test_what_has_no_distances_is_reported(tmp_path) -> None:
    with pytest.raises(ExportError, match="no obstacle"):
        export_map(map_of(occupancy_of([], free=[(0, 0, 0)])), "esdf", tmp_path / "a.npz", {"frame": "map"})
    with pytest.raises(ExportError, match="GiB"):
        esdf.states(occupancy_of([(0, 0, 0), (10_000, 10_000, 9)]))
    with pytest.raises(ExportError, match="30001 x 1 x 1 voxels"):
        esdf.states(occupancy_of([(0, 0, 0), (30_000, 0, 0)]))
    with pytest.raises(ConfigError, match="free, obstacle or nan"):
        export_map(map_of(scene()), "esdf", tmp_path / "a.npz", {"unknown": "lava"})
    with pytest.raises(ConfigError, match=r"\.npz or \.vdb"):
        export_map(map_of(scene()), "esdf", tmp_path / "a.esdf")
    assert not list(tmp_path.iterdir())
    nothing_else = occupancy_of([(0, 0, 0), (1, 0, 0)])
    assert (esdf.signed_distances(nothing_else, "free")[0] < 0).all()
