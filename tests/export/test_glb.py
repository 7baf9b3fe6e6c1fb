"""glTF files, loaded by trimesh and checked by Khronos' validator."""

import contextlib
import json
import shutil
import struct
import subprocess

import numpy as np
import pytest
from exported_maps import SPACE, VOXELS, map_of
from scenes import occupancy_of

from freeocc3d.core.errors import ConfigError, ExportError
from freeocc3d.core.transforms import transform
from freeocc3d.export import export_map
from freeocc3d.export.export_frames import place_voxels
from freeocc3d.occupancy.surface_faces import find_exposed_faces

trimesh = pytest.importorskip("trimesh")


@pytest.mark.parametrize("frame", ["gravity", "map", "start"])
def test_faces_stand_upright_where_the_frame_has_them(tmp_path, frame) -> None:
    scan_map = map_of(occupancy_of(VOXELS, free=SPACE))
    export_map(scan_map, "glb", tmp_path / "map.glb", {"frame": frame})
    scene = trimesh.load(tmp_path / "map.glb")
    there = place_voxels(scan_map, frame)
    mesh = scene.to_geometry() if hasattr(scene, "to_geometry") else scene.dump(concatenate=True)
    vertices, quads, _ = find_exposed_faces(there.occupancy)
    assert len(mesh.faces) == 2 * len(quads)
    x, y, z = vertices.T if frame != "map" else transform(scan_map.T_gravity_map, vertices).T
    expected = np.stack((x, z, -y), axis=1)
    if frame == "map":
        expected[:, 1] -= 1.52  # turned upright, not moved
    found = mesh.vertices
    np.testing.assert_allclose(found.min(axis=0), expected.min(axis=0), atol=1e-5)
    np.testing.assert_allclose(found.max(axis=0), expected.max(axis=0), atol=1e-5)
    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    assert merged.volume == pytest.approx(len(there.rows) * 1e-3, rel=1e-3)  # positive: faces look outwards


def test_colors_are_the_surfaces_as_light(tmp_path) -> None:
    scan_map = map_of(occupancy_of([(0, 14, 20)], colors=[(255, 128, 0)]))
    export_map(scan_map, "glb", tmp_path / "map.glb", {"frame": "map"})
    (mesh,) = trimesh.load(tmp_path / "map.glb").geometry.values()
    colors = mesh.visual.vertex_attributes["color"]  # beside the material
    assert {tuple(color) for color in np.asarray(colors).tolist()} == {(255, 55, 0, 255)}


def test_the_file_says_which_frame_it_is(tmp_path) -> None:
    scan_map = map_of(occupancy_of(VOXELS))
    export_map(scan_map, "glb", tmp_path / "map.glb")
    data = (tmp_path / "map.glb").read_bytes()
    magic, version, size, length, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    (node,) = json.loads(data[20 : 20 + length])["nodes"]
    assert node["extras"]["frame"] == "gravity"
    np.testing.assert_allclose(node["extras"]["T_frame_map"], scan_map.T_gravity_map)
    with pytest.raises(ExportError, match="no occupied voxels"):
        export_map(map_of(occupancy_of([], free=SPACE)), "glb", tmp_path / "b.glb")
    with pytest.raises(ConfigError, match="rgb, class"):
        export_map(scan_map, "glb", tmp_path / "b.glb", {"color": "loud"})


VALIDATE = """
const fs = require("fs"), validator = require("gltf-validator");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then(
    (report) => console.log(JSON.stringify(report)));
"""


@pytest.fixture(scope="module")
def gltf_validator(tmp_path_factory):
    """Khronos' validator, if npm can fetch it: (path) -> its report."""
    folder = tmp_path_factory.mktemp("npm")
    (folder / "validate.js").write_text(VALIDATE)
    npm, node = shutil.which("npm"), shutil.which("node")
    if npm and node:
        command = [npm, "install", "--no-audit", "--no-fund", "gltf-validator@2.0.0-dev.3.10"]
        with contextlib.suppress(subprocess.SubprocessError, OSError):
            subprocess.run(command, check=True, capture_output=True, timeout=120, cwd=folder)
            return lambda path: json.loads(
                subprocess.run(
                    [node, "validate.js", path], check=True, capture_output=True, timeout=60, cwd=folder
                ).stdout
            )
    pytest.skip("npm cannot fetch gltf-validator")


@pytest.mark.parametrize("options", [{"frame": "gravity"}, {"frame": "map", "color": "height"}])
def test_khronos_validator_finds_nothing(tmp_path, gltf_validator, options) -> None:
    scan_map = map_of(occupancy_of(VOXELS, free=SPACE))
    export_map(scan_map, "glb", tmp_path / "map.glb", options)
    report = gltf_validator(tmp_path / "map.glb")
    assert report["issues"]["messages"] == []
    assert report["info"]["totalTriangleCount"] == 2 * len(
        find_exposed_faces(place_voxels(scan_map, options["frame"]).occupancy)[1]
    )
    (tmp_path / "broken.glb").write_bytes((tmp_path / "map.glb").read_bytes()[:-4])
    assert gltf_validator(tmp_path / "broken.glb")["issues"]["numErrors"] > 0
