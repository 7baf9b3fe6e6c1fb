"""The summary of a map: what ``info`` prints, and the keys that other programs read in ``info --json``."""

import json
from pathlib import Path

import pytest

from freeocc3d.cli.map_summary import summary_document, summary_lines
from freeocc3d.query.scan_map import Map, load_map

PROMISED = {
    "version", "frames", "frames_with_pose", "submaps", "gaussians", "voxels", "voxel_size_m", "encoder", "bytes",
    "seconds", "peak_memory_bytes",
}  # fmt: skip
"""Keys that are never renamed."""


@pytest.fixture(scope="module")
def loaded(room: Path) -> Map:
    return load_map(room)


def test_the_document_has_the_promised_keys_and_is_json(loaded: Map) -> None:
    document = summary_document(loaded)
    assert set(document) >= PROMISED
    assert json.loads(json.dumps(document)) == document
    assert set(document["voxels"]) == {"occupied", "free"}
    assert document["voxels"]["occupied"] == len(loaded.occupancy.occupied_voxels())
    assert document["gaussians"] == len(loaded.gaussians)
    assert document["frames_with_pose"] == 8
    assert document["seconds"]["tracking"] > 0


def test_the_bytes_are_those_of_the_files(loaded: Map) -> None:
    for name, size in summary_document(loaded)["bytes"].items():
        path = loaded.path / name
        files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
        assert size == sum(file.stat().st_size for file in files)


def test_the_text_has_a_line_for_each_fact(loaded: Map) -> None:
    lines = {line.split()[0]: line for line in "\n".join(summary_lines(loaded)).splitlines()}
    assert {"map", "capture", "frames", "gaussians", "voxels", "encoder", "time", "memory"} <= set(lines)
    assert str(loaded.path) in lines["map"]
    assert "8 with a pose" in lines["frames"]
    assert f"{len(loaded.gaussians):,}" in lines["gaussians"]


def test_warnings_of_the_run_come_last(loaded: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    report = {**loaded.report, "warnings": [{"code": "frames-lost", "text": "Two frames are lost."}, "An old text."]}
    monkeypatch.setitem(vars(loaded), "report", report)
    assert "\n".join(summary_lines(loaded)).splitlines()[-2:] == [
        "warning    Two frames are lost.",
        "warning    An old text.",
    ]
    assert summary_document(loaded)["warnings"] == report["warnings"]
