"""Answers with whole objects against those of voxels, in maps with simulated features of CLIP at several noises.

A voxel has the embedding of its class's name (``clip_text_names.npz``; a class without one has that of another name),
half of it averaged over its neighbors as patches do, at cosine SIGNAL; an offset that all images share; and noise, half
of it shared with neighbors. Errors that all views of a thing share are not simulated, so figures of objects are
optimistic. The words are the names of the map's classes; CONTRAST other names compete.

The things are the objects of the map with its class images, of at least LEAST voxels. A thing is found if a region has
an IoU of at least ENOUGH with it; a region is right if it has it with an object of the word, however small. Objects are
divided by class images, as masks would, or by shape and color.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from .figures import Figures, tabulate
from .folders import MODELS

NOISE = (0.6, 0.8, 1.0)
SIGNAL, OFFSET = 0.27, 0.8
CONTRAST, NEIGHBORS, PATCH = 40, 20, 8
LEAST, ENOUGH, SHOWN = 60, 0.5, 20


def measure_object_answers(map_path: str) -> Figures:
    """Things found and regions right, by noise and by what the answers are."""
    from freeocc3d.language.feature_codec import Codec, CodedFeatures
    from freeocc3d.query import word_query
    from freeocc3d.query.objects.finding import average_features
    from freeocc3d.query.objects.ranking import pool_features, rank_objects
    from freeocc3d.query.objects.surface_instances import divide_surface
    from freeocc3d.query.scan_map import load_map

    scan_map = load_map(map_path)
    occupancy, things = scan_map.occupancy, scan_map.objects()
    classes = scan_map.text_encoder.contrast_words()
    names, embeddings = _embeddings(classes)
    words = _words(dict(zip(names, embeddings, strict=True)))
    of_voxel = word_query.nearest_word(occupancy.features, scan_map.text_encoder.encode_words(classes))
    shaped = divide_surface(scan_map)
    divided = {
        "objects by class images": [thing.rows for thing in things],
        "objects by shape and color": [np.flatnonzero(shaped == k) for k in np.unique(shaped[shaped >= 0])],
    }
    asked = sorted({thing.name for thing in things if len(thing.rows) >= LEAST})
    options = word_query.Options(top_k=max(len(of_voxel), 1))
    rows = []
    for noise in NOISE:
        features = _simulate(occupancy, embeddings[np.maximum(of_voxel, 0)] * (of_voxel >= 0)[:, None], noise)
        codec = Codec.fit(features)
        made = occupancy.replace(features=CodedFeatures(codec, codec.encode(features)))
        plain = word_query.query(made, words, asked, options)
        rows.append([noise, "voxels", *_score(plain, things)])
        for how, instances in divided.items():
            held, own = np.concatenate(instances), np.repeat(np.arange(len(instances)), [len(r) for r in instances])
            means = average_features(made, held, own)[0]
            objects = [replace(things[0], rows=one, feature=mean) for one, mean in zip(instances, means, strict=True)]
            pooled = word_query.query(pool_features(made, objects), words, asked, options)
            ranked = [rank_objects(made, *both, objects) for both in zip(plain, pooled, strict=True)]
            rows.append([noise, how, *_score(ranked, things)])
    return {"rows": rows}


def _embeddings(classes: list[str]) -> tuple[list[str], Any]:
    """Names, the classes first, and the (N, D) unit embeddings of each."""
    with np.load(MODELS / "clip_text_names.npz") as stored:
        known, vectors = stored["names"].tolist(), stored["embeddings"].astype(np.float32)
    others = [name for name in np.random.default_rng(0).permutation(known).tolist() if name not in classes]
    stand_ins = iter(others)
    of_class = [name if name in known else next(stand_ins) for name in classes]
    contrast = [next(stand_ins) for _ in range(CONTRAST)]
    found = vectors[[known.index(name) for name in (*of_class, *contrast)]]
    return [*classes, *contrast], found / np.linalg.norm(found, axis=1, keepdims=True)


def _words(table: dict[str, Any]) -> Any:
    """A text encoder that knows the words of a table."""
    from freeocc3d.language.encoders.base import TextEncoder, TextFeatures

    class Words(TextEncoder):
        threshold, temperature, knows, open_vocabulary = 0.0, 0.01, "a table of words", True

        def encode_words(self, words: Any) -> TextFeatures:
            width = len(next(iter(table.values())))
            return TextFeatures(np.array([table[word] for word in words], np.float32).reshape(-1, width), tuple(words))

        def contrast_words(self) -> list[str]:
            return list(table)

    return Words()


def _simulate(occupancy: Any, true: Any, noise: float) -> Any:
    """The (V, D) float16 unit features of voxels whose classes have the (V, D) embeddings ``true``; zero for none."""
    from scipy.spatial import KDTree

    rng = np.random.default_rng(0)
    centers = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges())
    near = KDTree(centers).query(centers, k=NEIGHBORS)[1]
    offset = rng.normal(size=true.shape[1])
    white = rng.normal(size=true.shape)
    shared = white[near].mean(axis=1)
    unit = [part / np.linalg.norm(part, axis=-1, keepdims=True) for part in (offset, white, shared)]
    signal = 0.5 * (true + true[near[:, :PATCH]].mean(axis=1))
    made = SIGNAL * signal + OFFSET * unit[0] + noise * np.sqrt(0.5) * (unit[1] + unit[2])
    made *= true.any(axis=1, keepdims=True) / np.linalg.norm(made, axis=1, keepdims=True)
    return made.astype(np.float16)


def _score(results: Any, things: Any) -> list[int]:
    """Things found, things, regions that are right, regions; of each word's first regions."""
    found = count = right = shown = 0
    for result in results:
        own = [thing.rows for thing in things if thing.name == result.word]
        iou = np.array([[_iou(rows, region.rows) for region in result.regions[:SHOWN]] for rows in own]).reshape(
            len(own), -1
        )
        large = np.array([len(rows) >= LEAST for rows in own])
        found += int((iou[large] >= ENOUGH).any(axis=1).sum())
        count += int(large.sum())
        right += int((iou >= ENOUGH).any(axis=0).sum())
        shown += iou.shape[1]
    return [found, count, right, shown]


def _iou(a: Any, b: Any) -> float:
    both = len(np.intersect1d(a, b))
    return both / (len(a) + len(b) - both)


def tabulate_object_answers(measured: list[Figures]) -> list[str]:
    """A table, a row for each capture, noise, and what the answers are."""
    rows = []
    for told in measured:
        if "error" in told:
            rows.append([told["capture"], "–", f"not available, {told['error']}", "–", "–"])
            continue
        for noise, how, found, count, right, shown in told["rows"]:
            rows.append([told["capture"], f"{noise}", how, f"{found} of {count}", f"{right} of {shown}"])
    return tabulate(["capture", "noise", "answers", "things found", "regions that are right"], rows)
