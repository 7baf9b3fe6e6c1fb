"""Divides the occupied voxels of a map into instances: things of the room, each a set of voxels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...language.class_names import match_names
from ...language.encoders.labels import LabelWords
from ...occupancy.connected_components import label_components
from ...storage.saved_map import SavedMap
from ..region_splitting import cut_necks
from ..word_query import Options, nearest_word

STRUCTURE = ("wall", "floor", "ceiling")
"""The surfaces that bound a room. They, and classes that are kinds of them, are no objects."""


def divide_into_instances(scan_map: SavedMap) -> NDArray[np.int32]:
    """Returns the (V,) instance of each occupied voxel, 0 … N-1; -1 for those of no object."""
    occupancy = scan_map.occupancy
    voxels, edges = occupancy.occupied_voxels(), occupancy.occupied_edges()
    text_encoder = scan_map.text_encoder
    if isinstance(text_encoder, LabelWords):
        classes = text_encoder.contrast_words()
        of_voxel = nearest_word(occupancy.features, text_encoder.encode_words(classes))
        structure = {row for word in STRUCTURE for row in match_names(word, classes)[0]}
        of_voxel[np.isin(of_voxel, list(structure))] = -1
    else:
        above = occupancy.centers(voxels, edges) @ scan_map.T_gravity_map[2, :3] + scan_map.T_gravity_map[2, 3]
        of_voxel = np.where(above > 1.5 * occupancy.voxel_size, 0, -1)
    instance = np.full(len(voxels), -1, np.int32)
    number = 0
    for k in np.unique(of_voxel[of_voxel >= 0]):
        rows = np.flatnonzero(of_voxel == k)
        component = label_components(voxels[rows], edges[rows])
        part = cut_necks(occupancy, rows, component, np.ones(len(rows), np.float32), scan_map.up, Options().narrow)
        instance[rows] = number + np.unique(part, return_inverse=True)[1]
        number = int(instance.max()) + 1
    return instance
