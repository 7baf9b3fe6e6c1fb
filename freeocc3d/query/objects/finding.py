"""Finds the objects of a map: its voxels are divided into instances, and each instance is described."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.types import Occupancy
from ...language.encoders.base import TextEncoder
from ...language.feature_codec import compute_cosines, mask_known
from ...language.random_words import list_house_names
from ...storage.saved_map import SavedMap
from ..oriented_boxes import oriented_boxes
from ..regions import best_regions
from .instances import divide_into_instances
from .object import Object, Options, Segment

_MOST_REGIONS = 1 << 31


def find_objects(scan_map: SavedMap, options: Options | None = None, segment: Segment | None = None) -> list[Object]:
    """Returns the objects of a map, highest confidence first. Walls, floors and ceilings are no objects.

    segment: gives the masks of a keyframe, instead of the model that the options name. Raises MapError for a damaged
    map, ModelError for a model of masks that does not exist or fails.
    """
    from ..best_views import best_views
    from .view_features import embed_views

    options = options or Options()
    instance = divide_into_instances(scan_map, segment or _load_masks(options), options.mask_keyframes)
    rows = np.flatnonzero(instance >= 0)
    instance = instance[rows]
    large = np.bincount(instance, minlength=1) >= options.min_voxels
    rows, instance = rows[large[instance]], instance[large[instance]]
    if not len(rows):
        return []
    feature, agreement = average_features(scan_map.occupancy, rows, instance)
    regions = best_regions(
        scan_map.occupancy, rows, instance, agreement, agreement, min_voxels=1, min_share=0.0, top_k=_MOST_REGIONS
    )
    which = [int(instance[np.searchsorted(rows, region.rows[0])]) for region in regions]
    views = best_views(scan_map.occupancy, scan_map.trajectory, scan_map.keyframes, regions, options.views)
    embedded = embed_views(scan_map, views, feature.shape[1])
    feature = np.where(mask_known(embedded)[:, None], embedded, feature[which])
    named = name_objects(scan_map, feature, options.names)
    boxes = oriented_boxes(scan_map.occupancy, regions, scan_map.T_gravity_map)
    return [
        Object(np.sort(region.rows), own, names, box, region.volume_m3, region.centroid, tuple(seen), region.score)
        for region, own, names, box, seen in zip(regions, feature, named, boxes, views, strict=True)
    ]


def _load_masks(options: Options) -> Segment | None:
    """What gives the masks of a keyframe, if the options name a model."""
    if not options.masks:
        return None
    from ...language.mask_networks import load_mask_network

    network = load_mask_network(options.masks, "masks", options.mask_points)
    return lambda frame: network.segment(frame.color)


def name_objects(scan_map: SavedMap, feature: NDArray[np.float32], most: int) -> list[tuple[tuple[str, float], ...]]:
    """Returns the most probable names of (N, D) features of objects: among the map's classes, or, for a model of any
    words, among the names that the scene has or things of houses.

    Such a model gives each word a cosine with any image, which says nothing of the object. The mean of the map's
    features holds it, and is taken off.
    """
    if not scan_map.text_encoder.open_vocabulary:
        return name_features(feature, scan_map.text_encoder, scan_map.vocabulary, most)
    words = scan_map.scene_words or list_house_names(scan_map.text_encoder.contrast_words())
    known = mask_known(feature)[:, None]
    centered = np.where(known, feature - scan_map.mean_feature, 0)
    return name_features(centered, scan_map.text_encoder, words, most)


def average_features(
    occupancy: Occupancy, rows: NDArray[np.int64], instance: NDArray[np.integer]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns the (N, D) unit mean feature of each instance, and the (n,) cosine, at least 0, of each voxel's feature
    with its instance's. rows: (n,) rows of occupied voxels.  instance: (n,) 0 … N-1."""
    from scipy.sparse import coo_array

    count = int(instance.max(initial=-1)) + 1
    features = np.asarray(occupancy.features[rows], np.float32)
    weight = (occupancy.occupied_edges()[rows] ** 3).astype(np.float32)
    total = coo_array((weight, (instance, np.arange(len(rows)))), shape=(count, len(rows))) @ features
    length = np.linalg.norm(total, axis=1, keepdims=True)
    mean = np.divide(total, length, out=np.zeros_like(total), where=length > 0)
    return mean, np.maximum(np.einsum("nd,nd->n", features, mean[instance]), 0)


def name_features(
    features: NDArray[np.float32], text_encoder: TextEncoder, vocabulary: list[str], most: int
) -> list[tuple[tuple[str, float], ...]]:
    """Returns the most probable names of (N, D) features, with the softmax of their products with the vocabulary's
    at the encoder's temperature; none for a zero feature."""
    text = text_encoder.encode_words(vocabulary)
    if not vocabulary or not features.size:
        return [()] * len(features)
    scores = compute_cosines(features, text.features).astype(np.float64) / text_encoder.temperature
    odds = np.exp(scores - scores.max(axis=1, keepdims=True)) * text.features.any(axis=1)
    share = odds / odds.sum(axis=1, keepdims=True)
    best = np.argsort(-share, axis=1, kind="stable")[:, :most]
    known = mask_known(features)
    return [
        tuple((vocabulary[k], float(own[k])) for k in order) if knows else ()
        for own, order, knows in zip(share, best, known, strict=True)
    ]
