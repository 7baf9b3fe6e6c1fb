"""OpenVDB files, read by a plain reader, and by OpenVDB's own Python module, Debian's python3-openvdb."""

import numpy as np
import pytest
from exported_maps import VDB_READERS

from freeocc3d.export.openvdb_files import write_vdb


@pytest.mark.parametrize("read_vdb", VDB_READERS)
@pytest.mark.parametrize("seed", range(2))
def test_every_voxel_is_read(tmp_path, seed, read_vdb) -> None:
    rng = np.random.default_rng(seed)
    # Leaves that share nodes, in other nodes, across the origin, and under other children of the root.
    keys = np.unique(np.concatenate((rng.integers(-20, 20, (12, 3)), rng.integers(-1500, 1500, (6, 3)))), axis=0)
    rng.shuffle(keys)
    values = rng.normal(size=(len(keys), 512)).astype(np.float32)
    active = rng.random((len(keys), 512)) < 0.4
    center = np.array((0.5, -2.0, 0.25))
    write_vdb(tmp_path / "a.vdb", "distance", keys, values, active, 0.04, center, {"frame": "gravity"})
    local = np.stack(np.unravel_index(np.arange(512), (8, 8, 8)), axis=1)
    indices = (keys[:, None] * 8 + local).reshape(-1, 3)
    told = read_vdb(tmp_path / "a.vdb", indices, tmp_path)
    assert told["name"] == "distance"
    assert told["background"] == 0
    assert told["active"] == active.sum()
    assert told["metadata"]["frame"] == "gravity"
    np.testing.assert_allclose(told["world"], [center, center + 0.04 * np.array((3, -5, 200))])
    found, is_active = map(np.array, zip(*told["values"], strict=True))
    np.testing.assert_array_equal(is_active, active.ravel())
    np.testing.assert_array_equal(found, np.where(active, values, 0).ravel())


@pytest.mark.parametrize("read_vdb", VDB_READERS)
def test_one_block(tmp_path, read_vdb) -> None:
    keys, values = np.zeros((1, 3), np.int32), np.full((1, 512), 2.5, np.float32)
    write_vdb(tmp_path / "a.vdb", "d", keys, values, values > 0, 1.0, np.zeros(3), {})
    assert read_vdb(tmp_path / "a.vdb", [(7, 0, 7), (8, 0, 0)], tmp_path)["values"] == [[2.5, True], [0.0, False]]
