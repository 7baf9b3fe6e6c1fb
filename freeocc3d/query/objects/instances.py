"""Divides the occupied voxels of a map into instances: things of the room, each a set of voxels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...language.class_names import match_names
from ...language.encoders.labels import LabelWords
from ...language.feature_codec import compute_cosines, mask_known
from ...occupancy.connected_components import label_components
from ...storage.saved_map import SavedMap
from ..region_splitting import cut_necks
from ..word_query import Options, nearest_word
from .object import Segment

STRUCTURE = ("wall", "floor", "ceiling")
"""The surfaces that bound a room. They, and classes that are kinds of them, are no objects."""


_AGREED, _MOSTLY = 0.9, 0.9
"""Cosine of a voxel's feature and its class where the views agree, and least share of such voxels in a map whose class
images tell things apart. Class images made by hand or drawn agree nearly everywhere; a network's differ from view to
view at a third of the voxels or more, and cut things into pieces."""


def divide_into_instances(scan_map: SavedMap, segment: Segment | None = None, most: int = 1) -> NDArray[np.int64]:
    """Returns the (V,) instance of each occupied voxel, 0 … N-1; -1 for those of no object.

    In a map with classes about which the views agree, the instances are the connected components of each class, cut at
    their necks; in others, the shape and the colors of the surface divide it.
    segment: gives the masks of a keyframe; with it, the masks of up to ``most`` keyframes divide the surface.
    """
    text_encoder = scan_map.text_encoder
    instance = (
        _divide_classes(scan_map, text_encoder) if segment is None and isinstance(text_encoder, LabelWords) else None
    )
    if instance is None:
        from .surface_instances import divide_surface

        instance = divide_surface(scan_map, segment, most)
    found = instance >= 0
    instance[found] = np.unique(instance[found], return_inverse=True)[1]
    return instance


def _divide_classes(scan_map: SavedMap, text_encoder: LabelWords) -> NDArray[np.int64] | None:
    """Returns the (V,) instance of each voxel by its class; None if the views do not agree about the classes."""
    occupancy = scan_map.occupancy
    voxels, edges = occupancy.occupied_voxels(), occupancy.occupied_edges()
    classes = text_encoder.contrast_words()
    text = text_encoder.encode_words(classes)
    known = mask_known(occupancy.features)
    agreed = compute_cosines(occupancy.features, text.features).max(axis=1, initial=0) >= _AGREED
    if agreed.sum() < _MOSTLY * known.sum():
        return None
    of_voxel = nearest_word(occupancy.features, text)
    structure = {row for word in STRUCTURE for row in match_names(word, classes)[0]}
    of_voxel[np.isin(of_voxel, list(structure))] = -1
    instance, number = np.full(len(voxels), -1), 0
    for k in np.unique(of_voxel[of_voxel >= 0]):
        rows = np.flatnonzero(of_voxel == k)
        component = label_components(voxels[rows], edges[rows])
        part = cut_necks(occupancy, rows, component, np.ones(len(rows), np.float32), scan_map.up, Options().narrow)
        instance[rows] = number + part
        number += int(part.max()) + 1
    return instance
