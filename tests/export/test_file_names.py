"""Names of exported files: YAML that quotes them, and endings of other formats."""

from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from exported_maps import map_of, map_server, room

from freeocc3d.core.errors import ConfigError
from freeocc3d.export import export_map
from freeocc3d.settings import registry

NAMES = (
    "floor #2", "map: v2", "*home", "[a]", "'q'", "{a", "- b", "&c", "!d", "%e", "@f", "| g", '"h', "yes", "1e3", "~",
    "Küche", " i ", "a\nb",
)  # fmt: skip
FOLDERS = ("poses",)


@pytest.mark.parametrize("name", NAMES)
def test_planners_find_the_image_whatever_the_name(tmp_path, name) -> None:
    scan_map = map_of(room()[0])
    nowhere = SimpleNamespace(understood=True, regions=[], note="There is no cup.")
    scan_map.query_words = lambda words, top_k, objects: [nowhere for _ in words]
    export_map(scan_map, "nav2", tmp_path / f"{name}.yaml", {"avoid": ["cup"], "min_height": -5})
    for beside in (name, f"{name}.cup", f"{name}.avoid"):
        described = yaml.safe_load((tmp_path / f"{beside}.yaml").read_text(encoding="utf-8"))
        assert described["image"] == f"{beside}.pgm"
        assert map_server(tmp_path / f"{beside}.yaml")[0].size > 0


@pytest.mark.parametrize(
    ("kind", "name", "said"),
    [
        ("ply", "map.splat", "must end in .ply, got 'map.splat'."),
        ("glb", "map.gltf", "must end in .glb, got 'map.gltf'."),
        ("glb", "map.ply", "must end in .glb, got 'map.ply'; .ply is of the format gaussians or ply."),
        ("gaussians", "map.splat", "must end in .ply"),
        ("npz", "map.npy", "must end in .npz"),
        ("nav2", "map.pgm", "must end in .yaml or .yml"),
        ("nav2", "map", "must end in .yaml or .yml, got 'map'."),
        ("octomap", "map.ply", "must end in .bt or .ot, got 'map.ply'; .ply is of the format gaussians or ply."),
        ("esdf", "map.nvdb", "must end in .npz or .vdb"),
        ("geojson", "map.shp", "must end in .geojson or .json"),
        ("voxel_block_grid", "map.bin", "must end in .npz"),
    ],
)
def test_endings_of_other_formats_are_refused_with_the_right_one(tmp_path, kind, name, said) -> None:
    with pytest.raises(ConfigError) as told:
        export_map(map_of(room()[0]), kind, tmp_path / name)
    assert said in str(told.value)
    assert not list(tmp_path.iterdir())


def test_every_exporter_of_a_file_states_its_endings() -> None:
    for name in registry.backends("export"):
        endings = getattr(registry.load("export", name), "ENDINGS", ())
        assert bool(endings) != (name in FOLDERS)
        assert all(not ending or (ending[0] == "." and ending == ending.lower()) for ending in endings)


def test_endings_may_be_in_capitals(tmp_path) -> None:
    scan_map = map_of(room()[0])
    export_map(scan_map, "octomap", tmp_path / "MAP.BT")
    assert (tmp_path / "MAP.BT").read_bytes().startswith(b"# Octomap OcTree binary file")
    export_map(scan_map, "npz", tmp_path / "MAP.NPZ")
    with np.load(tmp_path / "MAP.NPZ") as arrays:
        assert "occupancy" in arrays
