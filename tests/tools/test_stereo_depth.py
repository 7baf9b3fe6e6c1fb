"""The benchmark of stereo depth on the built-in room, and its table."""

import pytest
from benchmark import stereo_depth


def test_figures_of_the_room(monkeypatch: pytest.MonkeyPatch) -> None:
    room = stereo_depth.open_capture

    def small(path, options=None):
        return room(path, options, {"synthetic": {"frames": 72, "width": 160, "height": 120}})

    monkeypatch.setattr(stereo_depth, "open_capture", small)
    monkeypatch.setattr(stereo_depth, "_AROUND", 5)
    row = stereo_depth.measure_stereo("builtin:room", frames=1)
    assert row["compared"] == 1
    assert 0.0 <= row["kept"] <= 1.0
    (head, _, line) = stereo_depth.tabulate_stereo([{"capture": "room", **row}])[1:]
    assert head.count("|") == line.count("|")


def test_what_failed_is_reported() -> None:
    assert "no folder" in stereo_depth.tabulate_stereo([{"capture": "room", "error": "no folder"}])[-1]
    assert stereo_depth.tabulate_stereo([]) == []
