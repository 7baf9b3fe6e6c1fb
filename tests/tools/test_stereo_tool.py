"""The benchmark of stereo depth on the built-in room, and its table."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import stereo


def test_figures_of_the_room(monkeypatch: pytest.MonkeyPatch) -> None:
    room = stereo.open_capture

    def small(path, options=None):
        return room(path, options, {"synthetic": {"frames": 72, "width": 160, "height": 120}})

    monkeypatch.setattr(stereo, "open_capture", small)
    monkeypatch.setattr(stereo, "_AROUND", 5)
    row = stereo.measure_stereo("builtin:room", frames=1)
    assert row["compared"] == 1
    assert 0.0 <= row["kept"] <= 1.0
    (head, _, line) = stereo.stereo_lines([{"capture": "room", **row}])[1:]
    assert head.count("|") == line.count("|")


def test_what_failed_is_told() -> None:
    assert "no folder" in stereo.stereo_lines([{"capture": "room", "error": "no folder"}])[-1]
    assert stereo.stereo_lines([]) == []
