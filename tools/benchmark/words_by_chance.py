"""Asks maps with simulated CLIP features for what is there and what is not (``simulated_clip``), and compares what
random words decide with the fixed cosine that turns out best.

A capture is mapped with its class images and given poses, as in ``present_words``; then its keyframes are encoded as
CLIP would see them. A name that is there is found if its answer's IoU with the truth is at least half of what the
features allow: of the voxels whose nearest name among all that are there is this one. Nothing of the truth reaches a
query. Answers are those that ``query`` gives: whole objects first, found by shape and color. Those of voxels alone
stand beside.
"""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from .absent_words import absent_names, spread
from .figures import Figures, Line, tabulate_asked
from .folders import MODELS
from .present_words import LEAST
from .processes import PartFailed
from .true_frame import put_gaussians_in_world, put_keyframes_in_world

SEEDS = (0, 1)
ENOUGH = 0.5


def measure_words_by_chance(capture: str) -> Figures:
    """Shares of absent names that return something, and of present ones that are found, for each strength."""
    from freeocc3d.core.progress import Progress
    from freeocc3d.pipeline.run import reconstruct

    from .simulated_clip import STRENGTHS

    if not MODELS.is_dir():
        raise PartFailed(f"there are no embeddings of names: the folder {MODELS} is missing")
    settings = {"language": {"encoder": "labels"}, "tracking": {"backend": "known"}, "fitting": {"passes": 0}}
    with tempfile.TemporaryDirectory() as folder:
        made = reconstruct(capture, Path(folder) / "map", settings, progress=Progress())
        scene = Scene(made, Path(capture) / "ground_truth.npz")
        return {"strengths": {name: [scene.ask(name, seed) for seed in SEEDS] for name in STRENGTHS}}


class Scene:
    """A map on its truth's lattice."""

    def __init__(self, scan_map: Any, truth_path: Path):
        from freeocc3d.evaluation.ground_truth import load_ground_truth

        from .simulated_clip import Words

        self.scan_map, self.truth, self.words = scan_map, load_ground_truth(truth_path), Words()
        count = np.bincount(self.truth.labels.ravel(), minlength=256)
        self.present = [name for k, name in enumerate(self.truth.classes) if k and count[k]]
        self.asked = [name for k, name in enumerate(self.truth.classes) if k and count[k] >= LEAST]
        self.absent = spread(absent_names(self.words.names, self.present))

    def occupancy(self, strength: str, seed: int) -> Any:
        """The voxels with features as CLIP gives them, coded as maps store them."""
        from freeocc3d.language import lifting
        from freeocc3d.language.feature_codec import Codec, CodedFeatures
        from freeocc3d.occupancy import build
        from freeocc3d.settings import config

        from .simulated_clip import STRENGTHS, SimulatedClip

        made, capture = self.scan_map, self.scan_map.capture
        settings = config.load_saved(made.path / "config.yaml")
        encoder = SimulatedClip(self.words, capture.classes, capture.labels, STRENGTHS[strength], seed)
        poses = made.trajectory.T_world_keyframe
        features = lifting.lift_features(made.gaussians, made.keyframes, poses, encoder, settings.language)
        built = build.build_occupancy(
            put_gaussians_in_world(made),
            features,
            put_keyframes_in_world(made),
            settings.occupancy.changed(voxel_size=self.truth.voxel_size),
            settings.carving,
            origin=self.truth.origin,
        )
        codec = Codec.fit(features)
        return built.replace(features=CodedFeatures(codec, codec.encode(built.features)))

    def ask(self, strength: str, seed: int) -> Figures:
        """What random words decide, and the fixed cosine that is best in hindsight."""
        from freeocc3d.language.feature_codec import compute_cosines, mask_known

        from .simulated_clip import SimulatedWords

        occupancy = self.occupancy(strength, seed)
        voxels = occupancy.occupied_voxels()
        inside = ((voxels >= 0) & (voxels < self.truth.shape)).all(axis=1)
        true = np.full(len(voxels), 255, np.uint8)
        true[inside] = self.truth.labels[tuple(voxels[inside].T)]
        text = SimulatedWords(self.words)
        named = text.encode_words(self.present).features
        cosine = compute_cosines(occupancy.features, named)
        nearest = np.where(mask_known(occupancy.features), cosine.argmax(axis=1), -1)
        judged = Judged(self, true, nearest)
        decided = judged.share(occupancy, text, None, self.objects(occupancy))
        voxels_alone = judged.share(occupancy, text, None)
        lowest, highest = np.quantile(cosine[true < 255], (0.5, 0.999))
        fixed = {round(float(t), 3): judged.share(occupancy, text, float(t)) for t in np.linspace(lowest, highest, 8)}
        best = max(fixed, key=lambda t: fixed[t]["found"] - fixed[t]["absent_answered"])
        return {**decided, "voxels_alone": voxels_alone, "best_fixed": {"threshold": best, **fixed[best]}}

    def objects(self, occupancy: Any) -> list[Any]:
        """The things that the map's surface shows by shape and color, in the voxels of ``occupancy``, which lie on
        another lattice: each belongs to the nearest voxel of the map within an edge."""
        from scipy.spatial import KDTree

        from freeocc3d.core.transforms import transform
        from freeocc3d.query.objects.finding import average_features
        from freeocc3d.query.objects.object import Object
        from freeocc3d.query.objects.surface_instances import divide_surface
        from freeocc3d.query.oriented_boxes import OrientedBox

        own, T_world_map = self.scan_map.occupancy, np.array(self.scan_map.manifest.T_world_map)
        mapped = transform(T_world_map, own.centers(own.occupied_voxels(), own.occupied_edges()))
        centers = occupancy.centers(occupancy.occupied_voxels())
        nearest = KDTree(mapped).query(centers, distance_upper_bound=own.voxel_size)[1]
        instance = np.append(divide_surface(self.scan_map), -1)[nearest]
        rows = np.flatnonzero(instance >= 0)
        number = np.unique(instance[rows], return_inverse=True)[1]
        feature = average_features(occupancy, rows, number)[0]
        nowhere = OrientedBox(np.zeros(3), 0.0, np.eye(4))
        return [
            Object(rows[number == k], feature[k], (), nowhere, 0.0, np.zeros(3), (), 0.0) for k in range(len(feature))
        ]


@dataclasses.dataclass(frozen=True)
class Judged:
    """true: (V,) class of each occupied voxel.  nearest: (V,) row of the nearest present name."""

    scene: Scene
    true: Any
    nearest: Any

    def share(self, occupancy: Any, text: Any, threshold: float | None, objects: Any = ()) -> Figures:
        from freeocc3d.query import word_query
        from freeocc3d.query.objects.ranking import pool_features, rank_objects

        def ask(words: list[str]) -> list[Any]:
            plain = word_query.query(occupancy, text, words, options)
            if not objects:
                return plain
            pooled = word_query.query(pool_features(occupancy, objects), text, words, options)
            return [rank_objects(occupancy, *both, objects) for both in zip(plain, pooled, strict=True)]

        options = word_query.Options(threshold=threshold, top_k=1000)
        asked, absent = self.scene.asked, self.scene.absent
        known, found, as_oracle, missed = self.true != 255, [], [], []
        for result in ask(asked):
            answer = np.zeros(len(self.true), bool)
            answer[np.concatenate([np.zeros(0, np.int64), *(region.rows for region in result.regions)])] = True
            of_class = self.true == self.scene.truth.classes.index(result.word)
            oracle = (self.nearest == self.scene.present.index(result.word)) & known
            found.append(_iou(answer & known, of_class) >= ENOUGH * _iou(oracle, of_class))
            as_oracle.append(_iou(answer & known, oracle) >= ENOUGH)
            missed += [] if found[-1] else [result.word]
        answered = [result.word for result in ask(absent) if result.matched]
        return {
            "absent": len(absent),
            "absent_answered": len(answered) / len(absent),
            "present": len(asked),
            "found": float(np.mean(found)),
            "as_oracle": float(np.mean(as_oracle)),
            "missed": missed,
            "answered": answered,
        }


def _iou(a: Any, b: Any) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def tabulate_words_by_chance(rows: list[Figures]) -> list[str]:
    """A table of all captures."""
    return tabulate_asked(words_by_chance_lines(rows))


def words_by_chance_lines(rows: list[Figures]) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    lines: list[Line] = []
    for row in rows:
        if "error" in row:
            lines.append((row["capture"], f"not available, {row['error']}", ""))
            continue
        for strength, asked in row["strengths"].items():
            where = f"{row['capture']}, simulated CLIP, {strength}"

            def mean(key: str, of: list[Figures]) -> str:
                return f"{np.mean([own[key] for own in of]):.1%} ({', '.join(f'{own[key]:.1%}' for own in of)})"

            def gain(of: list[Figures]) -> str:
                return f"{np.mean([own['found'] - own['absent_answered'] for own in of]):.1%}"

            fixed, alone = ([own[key] for own in asked] for key in ("best_fixed", "voxels_alone"))
            middle = strength == "middle"
            lines += [
                (f"{where}: {asked[0]['absent']} absent names that return a region", mean("absent_answered", asked),
                 "≤ 5 %" if middle else ""),
                (f"{where}: {asked[0]['present']} present names that are found", mean("found", asked),
                 "≥ 90 %" if middle else ""),
                (f"{where}: the same two without objects",
                 f"{mean('absent_answered', alone)} and {mean('found', alone)}", ""),
                (f"{where}: answers with IoU ≥ {ENOUGH} with the nearest present name", mean("as_oracle", asked), ""),
                (f"{where}: found minus answered in vain, and with the best fixed cosine in hindsight",
                 f"{gain(asked)} and {gain(fixed)}",
                 "≥ the latter - 3 points" if strength == "hard" else ""),
            ]  # fmt: skip
    return lines
