"""OctoMap files, read by OctoMap itself: through pyoctomap, and by Debian's octomap-tools."""

import json
import shutil
import subprocess

import numpy as np
import pytest
from exported_maps import map_of, of_several_sizes
from scenes import occupancy_of

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.core.types import FREE, OCCUPIED
from freeocc3d.export import export_map, octomap
from freeocc3d.export.export_frames import place_voxels

pyoctomap = pytest.importorskip("pyoctomap")


def scattered(seed=0, count=1500):
    """Occupied and free voxels in a slanting cloud around the origin, with a free cube that prunes."""
    rng = np.random.default_rng(seed)
    voxels = np.unique(np.rint(rng.normal(0, (12, 6, 3), (count, 3))).astype(int) + (20, 0, 0), axis=0)
    cube = np.stack(np.meshgrid(*[np.arange(-24, -8)] * 3), axis=-1).reshape(-1, 3)
    half = len(voxels) // 2
    rng.shuffle(voxels)
    colors = rng.integers(0, 255, (half, 3))
    return occupancy_of(voxels[:half], colors=colors, free=np.concatenate((voxels[half:], cube)))


def read(path, kind=None):
    """The tree, or None for what OctoMap does not take."""
    tree = (kind or pyoctomap.OcTree)(0.5)
    if path.suffix == ".bt":
        assert tree.readBinary(str(path))
        return tree
    return tree.read(str(path))


def state_at(tree, point):
    node = tree.search(point)
    return None if node is None else OCCUPIED if tree.isNodeOccupied(node) else FREE


def states_of_leaves(tree, size):
    """{lower corner in voxels: (edge, state)} of the leaves."""
    out = {}
    for leaf in tree.begin_leafs():
        edge = round(leaf.getSize() / size)
        corner = np.rint((np.array(leaf.getCoordinate()) / size) - edge / 2).astype(int)
        out[tuple(corner.tolist())] = edge, OCCUPIED if tree.isNodeOccupied(leaf) else FREE
    return out


def cut(leaves):
    """{voxel: state} of leaves of any size."""
    return {
        tuple(np.add(corner, part).tolist()): state
        for corner, (edge, state) in leaves.items()
        for part in np.ndindex(edge, edge, edge)
    }


def expected_states(occupancy):
    leaves = {}
    for state in (FREE, OCCUPIED):
        for corner, edge in zip(occupancy.voxels(state).tolist(), occupancy.edges(state).tolist(), strict=True):
            leaves[tuple(corner)] = edge, state
    return cut(leaves)


@pytest.mark.parametrize("name", ["map.bt", "map.ot"])
@pytest.mark.parametrize("occupancy", [scattered(), of_several_sizes()], ids=["one size", "several"])
def test_octomap_reads_every_voxel_and_nothing_else(tmp_path, name, occupancy) -> None:
    path = tmp_path / name
    export_map(map_of(occupancy), "octomap", path, {"frame": "map"})
    tree = read(path)
    assert tree.getResolution() == pytest.approx(occupancy.finest)
    assert tree.calcNumNodes() == tree.size() == int(path.read_bytes().split(b"size ")[1].split(b"\n")[0])
    assert cut(states_of_leaves(tree, occupancy.finest)) == expected_states(occupancy)


def test_voxels_that_are_asked_one_by_one(tmp_path) -> None:
    scan_map = map_of(scattered())
    export_map(scan_map, "octomap", tmp_path / "map.bt", {"frame": "gravity"})
    tree, there = read(tmp_path / "map.bt"), place_voxels(scan_map, "gravity", origin=np.zeros(3)).occupancy
    for state in (FREE, OCCUPIED):
        for center in there.centers(there.voxels(state)):
            assert state_at(tree, center) == state
    assert state_at(tree, np.array((50.0, 50, 50))) is None
    described = json.loads((tmp_path / "map.bt.json").read_text())
    assert described["frame"] == "gravity"
    np.testing.assert_allclose(described["T_frame_map"], scan_map.T_gravity_map)


@pytest.mark.parametrize("occupancy", [scattered(), of_several_sizes()], ids=["one size", "several"])
def test_a_file_is_no_larger_than_octomaps_own(tmp_path, occupancy) -> None:
    for name in ("map.bt", "map.ot"):
        export_map(map_of(occupancy), "octomap", tmp_path / name, {"frame": "map"})
    tree = read(tmp_path / "map.bt")
    assert tree.writeBinary(str(tmp_path / "own.bt"))

    def body(path):
        return path.read_bytes().split(b"data\n", 1)[1]

    assert body(tmp_path / "own.bt") == body(tmp_path / "map.bt")
    assert read(tmp_path / "map.ot").write(str(tmp_path / "own.ot"))
    assert body(tmp_path / "own.ot") == body(tmp_path / "map.ot")


def test_colors_and_probabilities(tmp_path) -> None:
    occupancy = scattered()
    occupancy = occupancy.replace(probability=np.where(occupancy.state == OCCUPIED, 0.7, 0.6).astype(np.float32))
    export_map(map_of(occupancy), "octomap", tmp_path / "map.ot", {"frame": "map", "color": True})
    tree = read(tmp_path / "map.ot", pyoctomap.ColorOcTree)
    assert tree.getTreeType() == "ColorOcTree"
    for center, color in zip(occupancy.centers(occupancy.occupied_voxels()), occupancy.colors, strict=True):
        node = tree.search(center)
        assert tuple(node.getColor()) == tuple(color.tolist())
        assert node.getOccupancy() == pytest.approx(0.7, abs=1e-3)
    assert state_at(tree, occupancy.centers(occupancy.voxels(FREE))[0]) == FREE  # though its probability says else


@pytest.mark.skipif(shutil.which("compare_octrees") is None, reason="Debian's octomap-tools are not installed")
def test_debians_tools_open_and_compare(tmp_path) -> None:
    export_map(map_of(scattered()), "octomap", tmp_path / "map.bt", {"frame": "map"})
    export_map(map_of(scattered()), "octomap", tmp_path / "map.ot", {"frame": "map"})
    subprocess.run(["convert_octree", "map.ot", "again.bt"], cwd=tmp_path, check=True, capture_output=True)
    told = subprocess.run(
        ["compare_octrees", "map.ot", "map.ot"], cwd=tmp_path, check=True, capture_output=True, text=True
    )
    assert "KLD" in told.stdout + told.stderr
    assert (tmp_path / "again.bt").read_bytes().split(b"data\n")[1] == (
        (tmp_path / "map.bt").read_bytes().split(b"data\n")[1]
    )


def test_what_cannot_be_written_is_reported(tmp_path) -> None:
    scan_map = map_of(scattered())
    with pytest.raises(ConfigError, match=r"must end in \.bt"):
        export_map(scan_map, "octomap", tmp_path / "map.octree")
    with pytest.raises(ConfigError, match="no colors"):
        export_map(scan_map, "octomap", tmp_path / "map.bt", {"color": True})
    with pytest.raises(ExportError, match="farther than"):
        export_map(map_of(occupancy_of([(40_000, 0, 0)])), "octomap", tmp_path / "map.bt", {"frame": "map"})
    nothing = occupancy_of([(0, 0, 0)])
    nothing = nothing.replace(state=np.full_like(nothing.state, 255), colors=nothing.colors[:0])
    with pytest.raises(ExportError, match="no tree"):
        export_map(map_of(nothing), "octomap", tmp_path / "map.bt", {"frame": "map"})
    (tmp_path / "map.bt.json").write_text("mine")
    with pytest.raises(ExportError, match=r"map.bt.json already exists"):
        export_map(scan_map, "octomap", tmp_path / "map.bt")
    assert [path.name for path in tmp_path.iterdir()] == ["map.bt.json"]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_voxels_up_to_the_limit_of_the_keys_are_written_and_none_beyond(axis: int) -> None:
    first, last = np.zeros((2, 3), int)
    first[axis], last[axis] = -(1 << 15), (1 << 15) - 1
    (leaves,) = octomap.collect_leaves(occupancy_of([first], free=[last]), log_odds=False, color=False)
    assert leaves.corners[:, axis].tolist() == [-(1 << 15), (1 << 15) - 1]
    assert leaves.values.tolist() == [1.0, -1.0]
    for beyond in (first, last):
        outside = beyond + np.sign(beyond)
        with pytest.raises(ExportError, match="farther than 3277 m"):
            octomap.collect_leaves(occupancy_of([outside]), log_odds=False, color=False)
