"""Maps and scans that several files of the pipeline's tests use."""

from __future__ import annotations

import shutil

import pytest
from pipeline_runs import ROOM
from small_captures import data_folder

import freeocc3d
from freeocc3d import Map


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Map:
    return freeocc3d.reconstruct("builtin:room", tmp_path_factory.mktemp("maps") / "room", ROOM)


@pytest.fixture(scope="session")
def glued(tmp_path_factory):
    """A folder that holds two places: 15 frames of the bedroom, then 8 of the living room."""
    folder = tmp_path_factory.mktemp("glued") / "scan"
    (folder / "results").mkdir(parents=True)
    house = data_folder() / "house"
    shutil.copy(house / "bedroom" / "cam_params.json", folder)
    shown = [*((house / "bedroom", i) for i in range(0, 60, 4)), *((house / "living", i) for i in range(0, 32, 4))]
    for n, (source, i) in enumerate(shown):
        for kind in ("frame{:06d}.jpg", "depth{:06d}.png"):
            shutil.copy(source / "results" / kind.format(i), folder / "results" / kind.format(n))
    return folder
