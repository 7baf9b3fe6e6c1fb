"""Maps in memory for the tests of exporters, and readers of the exported files."""

from __future__ import annotations

import json
import subprocess
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from manifests import tiny_manifest
from scenes import occupancy_of
from vdb_files import read_vdb_plainly

from freeocc3d.core.transforms import invert
from freeocc3d.core.types import FREE, OCCUPIED, Occupancy
from freeocc3d.query.regions import Region

CAMERA_TO_UP = np.array([(0.0, 0, 1, 0), (-1, 0, 0, 0), (0, -1, 0, 1.52), (0, 0, 0, 1)])
"""A level camera at 1.52 m: x right, y down, z forward to x forward, y left, z up."""


class MapInMemory(SimpleNamespace):
    """What exporters use of a map."""

    @property
    def T_first_camera(self):
        posed = np.flatnonzero(self.trajectory.has_pose)
        return invert(self.trajectory.T_world_cam[posed[0]]) if len(posed) else None


def map_of(occupancy: Occupancy, T_gravity_map=CAMERA_TO_UP):
    poses = np.stack([np.full((4, 4), np.nan), np.eye(4)])
    return MapInMemory(
        metric=True,
        occupancy=occupancy,
        manifest=tiny_manifest(),
        vocabulary=["cup", "table"],
        labels=lambda: (np.arange(len(occupancy.colors)) % 3).astype(np.uint8),
        up=np.array((0.0, -1.0, 0.0)),
        T_gravity_map=T_gravity_map,
        trajectory=SimpleNamespace(has_pose=np.array((False, True)), T_world_cam=poses, timestamps=np.arange(2.0)),
    )


VOXELS, SPACE = [(0, 14, 20), (1, 14, 20), (3, 5, 21)], [(0, 13, 20), (0, 12, 20)]


def map_server(path):
    """The occupancy grid that map_server publishes of a map.yaml: data[row, column] of -1 or 0 to 100, row 0 at the
    smallest y; resolution; and the position of the grid's corner. Modes of nav2_map_server's map_io."""
    told = yaml.safe_load(path.read_text())
    free, occupied = told["free_thresh"], told["occupied_thresh"]
    assert occupied > free
    image = cv2.imread(str(path.with_name(told["image"])), cv2.IMREAD_UNCHANGED)
    height, width = image.shape
    data = np.full((height, width), -1)
    for y in range(height):
        for x in range(width):
            shade = image[y, x] / 255.0
            p = shade if told["negate"] else 1.0 - shade
            between = {"trinary": -1, "scale": np.rint((p - free) / (occupied - free) * 100.0)}[told["mode"]]
            data[height - y - 1, x] = 100 if p > occupied else 0 if p < free else between
    assert told["origin"][2] == 0
    return data, told["resolution"], np.array(told["origin"][:2])


def asked(scan_map):
    """The map with one region of all its voxels for "cup", and none for anything else."""
    center = scan_map.occupancy.centers(scan_map.occupancy.occupied_voxels())
    region = Region(0.8, 0.9, center.mean(axis=0), center.min(axis=0), center.max(axis=0), 8e-3, np.arange(len(center)))

    def query_words(words, top_k):
        assert top_k >= len(center)  # every region, however many there are
        found = {"cup": SimpleNamespace(word="cup", regions=[region], note="")}
        return [found.get(word, SimpleNamespace(word=word, regions=[], note=f"no {word}")) for word in words]

    scan_map.query_words = query_words
    return scan_map


Z_UP = np.eye(4)


def room():
    """A floor of 12 x 7 cells of 0.1 m at z = 0, seen free above, without what a chimney in one corner hides; a wall
    along y with a door, a table on one leg, a lamp that hangs high, a doorstep."""
    floor = [(i, j, 0) for i in range(12) for j in range(7)]
    wall = [(4, j, k) for j in range(7) for k in range(1, 19) if j not in (2, 3)]
    table = [(8, 5, k) for k in range(1, 7)] + [(7 + i, 4 + j, 7) for i in range(3) for j in range(2)]
    lamp = [(10, 1, 18)]
    doorstep = [(4, 2, 1)]  # a threshold, which lies below the lower height
    hidden = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in range(1, 19)]
    occupied = {*floor, *wall, *table, *lamp, *doorstep}
    free = [v for v in np.ndindex(12, 7, 19) if v[2] >= 1 and v not in occupied and v not in hidden]
    expected = np.zeros((7, 12), int)
    expected[[j for j in range(7) if j not in (2, 3)], 4] = 100
    expected[4:6, 7:10] = 100
    expected[0:2, 0:2] = -1
    return occupancy_of(sorted(occupied), free=free, origin=(-0.33, 2.0, -0.05)), expected


def of_several_sizes():
    rng = np.random.default_rng(3)
    keys = np.array([(0, 0, 0), (-1, 0, 2), (2, 0, 0), (2, 1, 1), (-8, 3, 1)], np.int32)
    state = rng.choice(np.uint8([FREE, OCCUPIED, 255]), (5, 512))
    state[4] = FREE
    return Occupancy(
        0.2, np.zeros(3), keys, np.where(state == OCCUPIED, 0.8, 0.02).astype(np.float32),
        np.zeros_like(state, np.uint16), np.zeros_like(state, np.uint16), state,
        features=np.zeros((np.count_nonzero(state == OCCUPIED), 2), np.float16),
        colors=rng.integers(0, 255, (np.count_nonzero(state == OCCUPIED), 3)).astype(np.uint8),
        levels=np.uint8([0, 0, 1, 1, 2]),
    )  # fmt: skip


READER = """
import json, sys
try:
    import openvdb as vdb
except ImportError:
    import pyopenvdb as vdb
grids, metadata = vdb.readAll(sys.argv[1])
(grid,) = grids
accessor = grid.getConstAccessor()
told = {
    "name": grid.name, "background": grid.background, "active": grid.activeVoxelCount(),
    "world": [list(grid.transform.indexToWorld(index)) for index in ((0, 0, 0), (3, -5, 200))],
    "metadata": {key: str(value) for key, value in grid.metadata.items()},
    "values": [accessor.probeValue(tuple(index)) for index in json.load(open(sys.argv[2]))],
}
print(json.dumps(told))
"""


def openvdb_python() -> str:
    """A Python that has OpenVDB, or skip the test."""
    for python in (sys.executable, "/usr/bin/python3"):
        for module in ("openvdb", "pyopenvdb"):
            try:
                if subprocess.run([python, "-c", f"import {module}"], capture_output=True).returncode == 0:
                    return python
            except OSError:
                continue
    pytest.skip("no Python has OpenVDB: apt-get install python3-openvdb")


def read_vdb(path, indices, tmp_path):
    (tmp_path / "asked.json").write_text(json.dumps(np.asarray(indices).tolist()))
    command = [openvdb_python(), "-c", READER, str(path), str(tmp_path / "asked.json")]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


VDB_READERS = [
    pytest.param(lambda path, indices, _: read_vdb_plainly(path, indices), id="plain"),
    pytest.param(read_vdb, id="openvdb"),
]
"""Each reads a grid from a file, with the values at indices; OpenVDB itself only where it is installed."""
