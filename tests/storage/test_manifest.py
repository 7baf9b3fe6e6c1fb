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
    with pytest.raises(MapError, match="removes that line"):
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
        ("finest_voxel_m", float("inf"), "not finite"),
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
