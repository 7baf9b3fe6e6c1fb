"""Maps and scans that several files of the pipeline's tests use."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
from made_once import make_once
from pipeline_runs import ONE_PASS, ROOM
from small_captures import data_folder

import freeocc3d
from freeocc3d import Map, load_map


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Map:
    def make(path: Path) -> None:
        freeocc3d.reconstruct("builtin:room", path, ROOM)

    return load_map(make_once(tmp_path_factory, "room-of-runs", make))


@pytest.fixture(scope="session")
def glued(tmp_path_factory):
    """A folder of two places, at a quarter of their size: 15 frames of the bedroom, then 8 of the living room."""
    return make_once(tmp_path_factory, "glued", _glue)


@pytest.fixture(scope="session")
def two_places(tmp_path_factory, glued) -> Map:
    def make(path: Path) -> None:
        freeocc3d.reconstruct(glued, path, ONE_PASS)

    return load_map(make_once(tmp_path_factory, "two-places", make))


def _glue(folder: Path) -> None:
    (folder / "results").mkdir(parents=True)
    house = data_folder() / "house"
    parameters = json.loads((house / "bedroom" / "cam_params.json").read_text())
    camera = parameters["camera"]
    camera.update({name: camera[name] // 4 for name in ("w", "h")}, fx=camera["fx"] / 4, fy=camera["fy"] / 4)
    camera.update({name: (camera[name] + 0.5) / 4 - 0.5 for name in ("cx", "cy")})
    (folder / "cam_params.json").write_text(json.dumps(parameters))
    shown = [*((house / "bedroom", i) for i in range(0, 60, 4)), *((house / "living", i) for i in range(0, 32, 4))]
    for n, (source, i) in enumerate(shown):
        for kind in ("frame{:06d}.jpg", "depth{:06d}.png"):
            image = cv2.imread(str(source / "results" / kind.format(i)), cv2.IMREAD_UNCHANGED)
            how = cv2.INTER_AREA if image.ndim == 3 else cv2.INTER_NEAREST
            small = cv2.resize(image, (camera["w"], camera["h"]), interpolation=how)
            cv2.imwrite(str(folder / "results" / kind.format(n)), small)
