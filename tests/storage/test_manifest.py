"""The manifest: what is written reads back, and damage is reported with file and field."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from manifests import tiny_manifest

from freeocc3d.core.checksums import hash_bytes
from freeocc3d.core.errors import MapError
from freeocc3d.storage.manifest import (
    FORMAT_VERSION,
    OLDEST_VERSION,
    MapScale,
    NameCount,
    Refined,
    SceneWords,
    manifest_keys,
    read_manifest,
    write_manifest,
)

CLIP = {"name": "clip", "dimension": 2, "state": {}}
CHANCE = {"evidence": 3.0, "spread": 1.0}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"finest_voxel_m": 0.025, "refined": Refined(map="maps/room")},
        {"refined": Refined(map="maps/room", box=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0))},
        {"vocabulary": SceneWords(keyframes=(0, 2), names={"sofa": NameCount(count=2, keyframes=(0, 2))})},
        {"scale": MapScale(metric=False, by="none")},
        {"files": {"report.json": 3}, "checksums": {"report.json": hash_bytes(b"abc")}},
    ],
)
def test_what_is_written_is_read(tmp_path: Path, changes: dict[str, Any]) -> None:
    manifest = tiny_manifest(**changes)
    write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path) == manifest


def test_a_map_states_the_oldest_version_that_has_all_its_keys() -> None:
    assert tiny_manifest().format_version == OLDEST_VERSION
    assert tiny_manifest(finest_voxel_m=0.05).format_version == FORMAT_VERSION
    assert max(key.since for key in manifest_keys()) == FORMAT_VERSION
    assert all(key.description for key in manifest_keys())


def test_no_byte_of_the_manifest_changes_without_a_word(tmp_path: Path) -> None:
    write_manifest(tmp_path, tiny_manifest())
    path = tmp_path / "map.yaml"
    whole = path.read_bytes()
    for place in range(0, whole.index(b"\n# xxh3_128"), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(MapError, match=r"map\.yaml"):
            read_manifest(tmp_path)


def test_who_edits_the_manifest_removes_its_checksum(tmp_path: Path) -> None:
    write_manifest(tmp_path, tiny_manifest())
    path = tmp_path / "map.yaml"
    edited = path.read_text().replace("camera to world", "world to camera")
    path.write_text(edited)
    with pytest.raises(MapError, match="remove that line"):
        read_manifest(tmp_path)
    path.write_text("\n".join(edited.splitlines()[:-1]))
    assert read_manifest(tmp_path).poses == "world to camera"


def test_a_map_from_before_scales_and_gravity_frames_is_read(tmp_path: Path) -> None:
    write_manifest(tmp_path, tiny_manifest())
    content = yaml.safe_load((tmp_path / "map.yaml").read_text())
    for key in ("scale", "codec", "frame", "poses"):
        del content[key]
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({**content, "a_later_key": 1}))
    manifest = read_manifest(tmp_path)
    assert manifest.scale == MapScale(metric=True, by="sensor", factor=1.0)
    assert manifest.T_gravity_map is None


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("voxel_size_m", "big", "'voxel_size_m' has text instead of a number"),
        ("voxel_size_m", 0, "'voxel_size_m' has a number that is not > 0.0"),
        ("voxel_size_m", float("nan"), "'voxel_size_m'"),
        ("voxel_size_m", float("inf"), "'voxel_size_m'"),
        ("voxel_size_m", 1e-300, "'voxel_size_m'"),
        ("voxel_size_m", 1e300, "'voxel_size_m'"),
        ("voxel_size_m", 10**400, "'voxel_size_m'|64 bits"),
        ("voxel_size_m", True, "'voxel_size_m' has true or false"),
        ("finest_voxel_m", 0.2, "'finest_voxel_m' is not 'voxel_size_m' halved"),
        ("finest_voxel_m", 0.07, "'finest_voxel_m' is not 'voxel_size_m' halved"),
        ("finest_voxel_m", 0.1 / 2**13, "'finest_voxel_m' is not 'voxel_size_m' halved"),
        ("origin", [0.0, 0.0, 1e300], "'origin'"),
        ("origin", [float("nan"), 0.0, 0.0], "'origin'"),
        ("up", [0.0, 0.0, 0.0], "'up' is not a unit vector"),
        ("up", [0.0, 0.0, 1e300], "'up' is not a unit vector"),
        ("T_gravity_map", [[1.0, 0, 0, 1e300], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]], "'T_gravity_map'"),
        ("T_first_camera", [[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1.0]], "'T_first_camera'"),
        ("upright", {"by": "floor"}, "'upright' lacks 'off_deg'"),
        ("keyframes", [2, 0], "'keyframes' are not frames of the capture in ascending order"),
        ("keyframes", [0, 0], "'keyframes' are not frames of the capture in ascending order"),
        ("keyframes", [0, 240], "'keyframes' are not frames of the capture in ascending order"),
        ("keyframes", [0, 2**40], r"'keyframes\[1\]' has a number that is not <="),
        ("keyframes", [0, 1, 2, 3], "'counts' holds fewer frames"),
        ("capture", {"path": "a\0b", "format": "x"}, "a character that no name has"),
        ("refined", {"map": 3}, "'refined.map' has a whole number instead of text"),
        ("refined", {"map": "x", "box": [0, 0, 0, 1, 1, float("inf")]}, "'refined.box'"),
        ("vocabulary", {"model": 3, "keyframes": [], "names": {}}, "'vocabulary.model' has a whole number"),
        ("encoder", {"name": ["color"], "state": {}}, "'encoder.name' has a list"),
        ("encoder", {**CLIP, "chance": {**CHANCE, "evidence": float("nan")}}, "'encoder.chance.evidence' has a number"),
        ("encoder", {**CLIP, "chance": {**CHANCE, "center": "no base64"}}, "'encoder.chance.center'"),
        ("encoder", {**CLIP, "chance": {**CHANCE, "center": "ADwAPAA8"}}, "'encoder.chance.center' is not the mean"),
        ("encoder", {**CLIP, "chance": {**CHANCE, "center": "AH4AAA=="}}, "'encoder.chance.center' is not the mean"),
        ("finest_voxel_m", float("inf"), "'finest_voxel_m'"),
        ("origin", [0.0, 0.0], "'origin' has 2 entries instead of 3"),
        ("up", None, "'up' has nothing instead of a list"),
        ("encoder", {"state": {}}, "'encoder' lacks 'name'"),
        ("counts", {}, "'counts' lacks 'gaussians'"),
        ("keyframes", [0, "one"], r"'keyframes\[1\]' has text instead of a whole number"),
        ("files", {"../../secret": 1}, "secret, which lies outside"),
        ("T_world_map", (2 * np.eye(4)).tolist(), "'T_world_map' is not a rigid transform"),
        ("checksums", {"report.json": "0" * 31}, r"'checksums\[\.\.\.\]'"),
        ("scale", {"factor": 2.0}, "'scale' lacks 'metric'"),
        ("scale", {"metric": True, "factor": float("nan")}, r"'scale\.factor' is not a finite number"),
        ("scale", {"metric": True, "factor": -1.0}, r"'scale\.factor' is not a finite number"),
        ("vocabulary", {"keyframes": [], "names": {"sofa": 3}}, "'vocabulary.names"),
    ],
)
def test_a_damaged_manifest_is_named_with_the_field(tmp_path: Path, field: str, value: Any, said: str) -> None:
    write_manifest(tmp_path, tiny_manifest())
    content = yaml.safe_load((tmp_path / "map.yaml").read_text())
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({**content, field: value}))
    with pytest.raises(MapError, match=rf"map\.yaml is damaged: .*{said}.*\.$"):
        read_manifest(tmp_path)


@pytest.mark.parametrize("version", [OLDEST_VERSION - 1, FORMAT_VERSION + 1, "2", None])
def test_other_versions_are_refused(tmp_path: Path, version: Any) -> None:
    write_manifest(tmp_path, tiny_manifest())
    content = yaml.safe_load((tmp_path / "map.yaml").read_text())
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({**content, "format_version": version}))
    with pytest.raises(MapError, match="format"):
        read_manifest(tmp_path)


def test_a_key_that_every_map_has_is_missed(tmp_path: Path) -> None:
    write_manifest(tmp_path, tiny_manifest())
    content = yaml.safe_load((tmp_path / "map.yaml").read_text())
    required = [key.name for key in manifest_keys() if key.required]
    assert set(required) < set(content)
    for name in required:
        (tmp_path / "map.yaml").write_text(yaml.safe_dump({key: v for key, v in content.items() if key != name}))
        with pytest.raises(MapError, match=f"lacks '{name}'"):
            read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("voxel_size_m: 2024-13-45", "is not a timestamp"),
        ("voxel_size_m: !!int abc", "'abc' is not a whole number"),
        ("voxel_size_m: !!float x", "'x' is not a float"),
        ("voxel_size_m: !!timestamp x", "is not a timestamp"),
        ("voxel_size_m: !!bool x", "'x' is not a bool"),
        ("voxel_size_m: " + "9" * 5000, "64 bits"),
        ("voxel_size_m: " + "[" * 3000, "line"),
        ("voxel_size_m: 0.1\nvoxel_size_m: 0.2", "the key 'voxel_size_m' appears twice"),
        ("voxel_size_m: &a [*a]", "stands for nothing"),
        ("? [voxel_size_m]\n: 3", "a key is a list"),
        ("voxel_size_m: \x00", "map.yaml"),
    ],
)
def test_values_that_yaml_libraries_stumble_over_are_told(tmp_path: Path, line: str, said: str) -> None:
    write_manifest(tmp_path, tiny_manifest())
    lines = (tmp_path / "map.yaml").read_text().splitlines()[:-1]
    text = "\n".join(line if one.startswith("voxel_size_m") else one for one in lines)
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(MapError, match=rf"map\.yaml is damaged: .*{said}|{said}"):
        read_manifest(tmp_path)


@pytest.mark.parametrize("data", [b"\xff\xfe\x00", b"\x80abc", "format_version: 2".encode("utf-16")])
def test_a_manifest_in_another_encoding_is_told(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "map.yaml").write_bytes(data)
    with pytest.raises(MapError, match=r"map\.yaml"):
        read_manifest(tmp_path)
