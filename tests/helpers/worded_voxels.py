"""Voxels with features of a few words, for the tests of queries."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from freeocc3d.core.types import BLOCK, FREE, OCCUPIED, Occupancy
from freeocc3d.language.encoders.labels import LabelWords

SIZE = 0.1
CLASSES = ["nothing", "cup", "sofa", "coffee table", "dining table", "wall"]
CUP, SOFA, COFFEE, DINING, WALL = range(5)
WORDS = LabelWords(CLASSES)


def occupancy(things: dict[tuple[int, int, int], NDArray[np.floating]], origin: object = (0.0, 0.0, 0.0)) -> Occupancy:
    """A map with exactly these occupied voxels and their features."""
    voxels = np.array(list(things), np.int64).reshape(-1, 3)
    keys = np.unique(voxels // BLOCK, axis=0).astype(np.int32)
    state = np.full((len(keys), BLOCK**3), FREE, np.uint8)
    for voxel in voxels:
        block = np.flatnonzero((keys == voxel // BLOCK).all(axis=1))[0]
        i, j, k = voxel % BLOCK
        state[block, (i * BLOCK + j) * BLOCK + k] = OCCUPIED
    counts = np.zeros(state.shape, np.uint16)
    made = Occupancy(SIZE, np.array(origin, float), keys, np.ones(state.shape, np.float32), counts, counts, state)
    features = [things[tuple(voxel)] for voxel in made.occupied_voxels().tolist()]
    dimension = len(CLASSES) - 1
    return made.replace(features=np.array(features, np.float16).reshape(len(features), dimension))


def feature(**shares: float) -> NDArray[np.floating]:
    """Unit feature with shares of classes, which are named as the constants above."""
    f = np.zeros(len(CLASSES) - 1)
    for name, share in shares.items():
        f[globals()[name]] = share
    return f / max(float(np.linalg.norm(f)), 1e-9)


def box(lo: tuple[int, int, int], hi: tuple[int, int, int], f: NDArray[np.floating]) -> dict:
    return dict.fromkeys(product(*(range(a, b) for a, b in zip(lo, hi, strict=True))), f)
