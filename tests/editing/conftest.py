"""One map of the whole built-in room, for most of what changes a map into another one."""

from pathlib import Path

import pytest
from made_once import make_once

from freeocc3d.pipeline import run as pipeline
from freeocc3d.query.scan_map import Map, load_map

SETTINGS = {
    "capture": {"stride": 8, "color_focal": 1.0, "synthetic": {"width": 320, "height": 240}},
    "tracking": {"backend": "known"},
    "fitting": {"passes": 0},
}


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Map:
    def make(path: Path) -> None:
        pipeline.reconstruct("builtin:room", path, SETTINGS)

    return load_map(make_once(tmp_path_factory, "room-to-edit", make))
