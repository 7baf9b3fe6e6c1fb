"""The built-in room with class images, for the tests of objects."""

from __future__ import annotations

import pytest
from made_once import make_once

import freeocc3d
from freeocc3d.query.scan_map import Map, load_map

_SETTINGS = {
    "capture": {"stop": 8, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}},
    "tracking": {"backend": "known"},
    "language": {"encoder": "labels"},
    "fitting": {"passes": 0},
}


def labeled_room(factory: pytest.TempPathFactory) -> Map:
    """The map, made once in a session."""
    return load_map(
        make_once(factory, "labeled-room", lambda path: freeocc3d.reconstruct("builtin:room", path, _SETTINGS))
    )
