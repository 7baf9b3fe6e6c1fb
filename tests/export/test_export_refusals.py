"""All exporters: what they refuse, and that a failed export leaves nothing behind."""

import errno
from types import SimpleNamespace

import numpy as np
import pytest
from exported_maps import CAMERA_TO_UP, Z_UP, asked, map_of, of_several_sizes, room
from manifests import tiny_manifest
from scenes import cameras, gaussians, occupancy_of, wall_frame

from freeocc3d.core.errors import ConfigError, ExportError, FreeOccError
from freeocc3d.export import export_map
from freeocc3d.language.encoders.labels import LabelWords
from freeocc3d.query.objects.object import Object
from freeocc3d.query.oriented_boxes import oriented_boxes
from freeocc3d.query.regions import best_regions
from freeocc3d.settings import registry
from freeocc3d.storage.keyframes import Keyframes
from freeocc3d.storage.manifest import EncoderRecord

FILES = {
    "ply": ("map.ply",), "npz": ("map.npz",), "octomap": ("map.bt", "map.ot"), "nav2": ("map.yaml",),
    "esdf": ("map.npz", "map.vdb"), "glb": ("map.glb",), "geojson": ("map.geojson",), "gaussians": ("map.ply",),
    "poses": ("poses",), "voxel_block_grid": ("grid.npz",), "ros2bag": ("map.mcap", "bag"),
    "objects": ("map.json", "map.glb"),
}  # fmt: skip
CASES = [(kind, name) for kind, names in FILES.items() for name in names]
OF_VOXELS = [case for case in CASES if case[0] not in ("gaussians", "poses", "geojson", "objects")]
BESIDE = {"voxel_block_grid": "grid.npz.json", "nav2": "map.pgm", "octomap": "map.bt.json", "gaussians": "map.ply.json"}


@pytest.fixture(scope="module")
def keyframes(tmp_path_factory):
    taken = Keyframes(tmp_path_factory.mktemp("keyframes"))
    for index in (0, 4):
        taken.append(wall_frame(2.0, index))
    return taken


def whole(occupancy, keyframes, T_gravity_map=Z_UP):
    """A map with all that any exporter asks for."""
    scan_map = map_of(occupancy, T_gravity_map)
    scan_map = asked(scan_map) if len(occupancy.colors) else scan_map
    scan_map.gaussians = gaussians(np.random.default_rng(0).uniform(0, 1, (20, 3)), 0.02)
    scan_map.keyframes = keyframes
    scan_map.text_encoder = LabelWords(["nothing", "cup", "table"])
    scan_map.vocabulary = scan_map.text_encoder.contrast_words()
    scan_map.manifest = tiny_manifest(encoder=EncoderRecord(name="labels", state={}))
    scan_map.trajectory.T_world_keyframe = cameras(2)
    scan_map.objects = lambda: one_object(scan_map)
    scan_map.relations_of = lambda objects: [() for _ in objects]
    return scan_map


def one_object(scan_map):
    """All voxels as one object."""
    occupancy = scan_map.occupancy
    rows = np.arange(len(occupancy.colors))
    alike = np.ones(len(rows), np.float32)
    regions = best_regions(occupancy, rows, np.zeros(len(rows), np.int32), alike, alike, 1, 0.0, 1)
    boxes = oriented_boxes(occupancy, regions, scan_map.T_gravity_map) if regions else []
    return [
        Object(region.rows, np.ones(2, np.float32), (("cup", 1.0),), box, region.volume_m3, region.centroid, (), 1.0)
        for region, box in zip(regions, boxes, strict=True)
    ]


def test_every_exporter_is_among_the_cases() -> None:
    assert set(FILES) == set(registry.backends("export"))


def refused(scan_map, kind, path, options=None) -> str:
    """The one sentence that says why, nothing being left."""
    before = {other: other.read_bytes() for other in path.parent.iterdir()}
    with pytest.raises(FreeOccError) as error:
        export_map(scan_map, kind, path, options)
    said = str(error.value)
    assert said.endswith(".")
    assert "\n" not in said
    assert {other: other.read_bytes() for other in path.parent.iterdir()} == before
    return said


@pytest.mark.parametrize(("kind", "name"), [case for case in CASES if case[0] not in ("gaussians", "poses")])
def test_an_empty_map_is_refused(tmp_path, keyframes, kind, name) -> None:
    said = refused(whole(occupancy_of([]), keyframes), kind, tmp_path / name)
    assert "voxel" in said or "known" in said or said == "No objects were found in the map."


@pytest.mark.parametrize(("kind", "name"), OF_VOXELS)
def test_a_box_outside_of_the_map_is_refused(tmp_path, keyframes, kind, name) -> None:
    scan_map = whole(room()[0], keyframes)
    said = refused(scan_map, kind, tmp_path / name, {"box": [10, 10, 10, 11, 11, 11]})
    assert said.startswith("Nothing of the map lies in the box: in the ")
    assert "x -0." in said
    said = refused(scan_map, kind, tmp_path / name, {"box": [1, 0, 0, 0, 1, 1]})
    assert f"'{kind}.box' takes a lower and an upper corner" in said
    said = refused(scan_map, kind, tmp_path / name, {"box": [0, 0, 0, 1, 1]})
    assert f"'{kind}.box' must be a list of 6 numbers or null, got [0, 0, 0, 1, 1]" in said


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_numbers_that_are_none_are_refused(tmp_path, keyframes, kind, name) -> None:
    scan_map = whole(room()[0], keyframes)
    for option in registry.backends("export")[kind].options:
        for value in (float("nan"), float("inf"), "nan"):
            if option.type.startswith("a number"):
                said = refused(scan_map, kind, tmp_path / name, {option.name: value})
                assert f"'{kind}.{option.name}' must be a" in said
            if option.name == "box":
                said = refused(scan_map, kind, tmp_path / name, {"box": [0, 0, 0, 1, 1, value]})
                assert f"'{kind}.box' must be" in said


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_what_exists_is_kept_unless_it_is_to_be_replaced(tmp_path, keyframes, kind, name) -> None:
    scan_map = whole(room()[0], keyframes)
    (tmp_path / name).write_text("mine")
    assert "--overwrite" in refused(scan_map, kind, tmp_path / name)
    (tmp_path / name).unlink()
    if beside := BESIDE.get(kind, "") if name != "map.ot" else "":
        (tmp_path / beside).write_text("mine")
        assert "--overwrite" in refused(scan_map, kind, tmp_path / name)
        export_map(scan_map, kind, tmp_path / name, overwrite=True)
        assert (tmp_path / beside).read_bytes() != b"mine"
    with pytest.raises(ExportError, match="there is no folder"):
        export_map(scan_map, kind, tmp_path / "missing" / name)


@pytest.mark.parametrize("name", ["map.ply", "map.yaml"])
def test_of_a_disk_that_fills_up_nothing_is_left(tmp_path, monkeypatch, name) -> None:
    def write(scan_map, path, options):
        path.write_text("half")
        path.with_suffix(".part").write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(registry, "load", lambda folder, kind: SimpleNamespace(write=write))
    monkeypatch.setattr(registry, "build_options", lambda module, values, where: None)
    assert "the disk is full" in refused(None, "any", tmp_path / name)


def test_a_place_that_cannot_be_written_to_is_reported(keyframes) -> None:
    with pytest.raises(ExportError, match=r"Cannot write /proc/map\.npz: "):
        export_map(whole(room()[0], keyframes), "npz", "/proc/map.npz")


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_a_name_that_is_none_has_its_nearest(tmp_path, keyframes, kind, name) -> None:
    with pytest.raises(ConfigError, match=f"did you mean '{kind}'"):
        export_map(whole(room()[0], keyframes), kind[:-1], tmp_path / name)


@pytest.mark.parametrize("frame", ["gravity", "start"])
@pytest.mark.parametrize(("kind", "name"), CASES)
def test_maps_of_several_sizes_go_through_every_exporter(tmp_path, keyframes, kind, name, frame) -> None:
    scan_map = whole(of_several_sizes(), keyframes, CAMERA_TO_UP)
    assert export_map(scan_map, kind, tmp_path / name, {"frame": frame}) == []
    assert (tmp_path / name).exists()


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_a_voxel_larger_than_the_room_is_written_or_reported(tmp_path, keyframes, kind, name) -> None:
    huge = occupancy_of([(0, 0, 0)], free=[(0, 0, 1)]).replace(voxel_size=20.0)
    scan_map = whole(huge, keyframes)
    if kind in ("nav2", "ros2bag"):
        assert "no plan to write" in refused(scan_map, kind, tmp_path / name)
    else:
        export_map(scan_map, kind, tmp_path / name)


def test_maps_of_several_sizes_keep_their_volume_and_extent_in_their_own_frame(tmp_path, keyframes) -> None:
    trimesh = pytest.importorskip("trimesh")
    several = of_several_sizes()
    scan_map = whole(several, keyframes, CAMERA_TO_UP)
    corners, edges = several.occupied_voxels() * several.finest, several.occupied_edges()[:, None] * several.finest
    for name in ("map.ply", "map.glb"):
        export_map(scan_map, name[4:], tmp_path / name, {"frame": "map"})
        low, high = trimesh.load(tmp_path / name, process=False).bounds
        x, y, z = np.stack((corners.min(axis=0), (corners + edges).max(axis=0))).T
        expected = (x, y, z) if name == "map.ply" else (z, -y, x)  # the map has y down, a .glb up
        np.testing.assert_allclose(
            np.sort(np.stack((low, high)), axis=0), np.sort(np.transpose(expected), axis=0), atol=1e-6
        )
    export_map(scan_map, "npz", tmp_path / "map.npz", {"frame": "map"})
    with np.load(tmp_path / "map.npz") as file:
        assert (file["occupancy"] == 1).sum() * float(file["voxel_size"]) ** 3 == pytest.approx((edges**3).sum())
