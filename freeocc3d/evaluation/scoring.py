"""Scores scenes one by one and pools them: what ``freeocc3d evaluate`` does.

Every figure comes with its context: the scored classes, the masks, and what could not be scored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ..core.errors import FreeOccError
from ..query.scan_map import Map, load_map
from ..tracking.trajectory_alignment import Poses, read_poses
from .confusion import Scores, count_confusion
from .embodiedocc import find_package, read_split
from .ground_truth import load_ground_truth
from .scene_scoring import ScoredScene, score_frames, score_gaussians, score_grid, score_map
from .scored_classes import EMBODIEDOCC, SHARED, ClassMap, load_class_map, map_each_to_itself
from .true_occupancy import GroundTruth

PRIMARY_MASK = "label"
TOP = (10, 20, 30, 40)


@dataclass(frozen=True)
class ScoringRequest:
    """The things to score: maps, or one of ``gaussians``, ``grid`` and ``frames``, as on the command line.

    ground_truths: one for each map, or one folder of packages; if empty, the captures' own ``ground_truth.npz``.
    poses: one for each map; if empty, the captures' own.  classes: a class file.  split: a file that lists the scenes
    to score.  overrides: options of layer 4.  align: se3, sim3 or none; None = sim3 if a map's scale is unknown, else
    se3.
    """

    maps: Sequence[Path] = ()
    gaussians: Path | None = None
    grid: Path | None = None
    frames: Path | None = None
    trajectory: Path | None = None
    ground_truths: Sequence[Path] = ()
    poses: Sequence[str] = ()
    align: str | None = None
    classes: Path | None = None
    split: Path | None = None
    overrides: Sequence[str] = ()


def evaluate_scenes(asked: ScoringRequest) -> Evaluation:
    """Reads the inputs, scores each scene and pools the scores. Raises FreeOccError for inputs that do not fit."""
    maps = [load_map(path) for path in asked.maps]
    how = asked.align or ("se3" if all(scan_map.metric for scan_map in maps) else "sim3")
    if asked.split is not None:
        maps = _in_split(maps, asked.split)
    count = max(len(maps), 1)
    listed = None if asked.classes is None else load_class_map(asked.classes)
    captures = [scan_map.manifest.capture.path for scan_map in maps] or list(asked.poses)
    truths = _truths(captures, asked.ground_truths, count, listed)
    if len(asked.poses) not in (0, count):
        raise FreeOccError(
            f"--poses is given {len(asked.poses)} times for {count} scenes: give it once for each scene, or never."
        )
    poses: list[Poses | None] = [read_poses(path) for path in asked.poses] or [None] * count
    classes = listed or collect_common_classes(truths)
    truths = [classes.apply(truth, str(asked.classes)) for truth in truths]
    trajectory = None if asked.trajectory is None else read_poses(asked.trajectory)
    for other in (asked.gaussians, asked.grid, asked.frames):
        if other is not None and not other.exists():
            raise FreeOccError(f"There is no file or folder {other} to score.")
    if maps:
        scenes = [
            score_map(scan_map, truth, classes, true, how, asked.overrides)
            for scan_map, truth, true in zip(maps, truths, poses, strict=True)
        ]
    elif asked.gaussians is not None:
        scenes = [score_gaussians(asked.gaussians, truths[0], classes, trajectory, poses[0], how, asked.overrides)]
    elif asked.grid is not None:
        scenes = [score_grid(asked.grid, truths[0], classes, trajectory, poses[0], how)]
    elif asked.frames is not None:
        if poses[0] is None:
            raise FreeOccError("Per-frame Gaussians need true poses: name them with --poses.")
        scenes = [score_frames(asked.frames, truths[0], classes, poses[0], asked.overrides)]
    else:
        raise FreeOccError("There is nothing to score: give a map, or --gaussians, --grid or --frames.")
    return Evaluation(tuple(scenes), classes.classes, how, listed is not None)


def name_scene(scan_map: Map) -> str:
    """Returns a map's scene: the name of the capture's folder."""
    return Path(scan_map.manifest.capture.path).name


def _in_split(maps: list[Map], split: Path) -> list[Map]:
    """Returns the maps of the scenes in a split, in its order. Raises FreeOccError if a map is missing."""
    by_name = {name_scene(scan_map): scan_map for scan_map in maps}
    scenes = read_split(split)
    missing = [name for name in scenes if name not in by_name]
    if missing:
        raise FreeOccError(
            f"{split} lists {len(missing)} scenes without a map, the first is {missing[0]}: give a map for each scene, "
            "because a score over a part of a split is not the score of the split."
        )
    return [by_name[name] for name in scenes]


def _truths(captures: Sequence[str], paths: Sequence[Path], count: int, classes: ClassMap | None) -> list[GroundTruth]:
    """Returns the truth of each scene. captures: their folders, which hold the truths if no paths are given.

    classes: those of the class file, which names the labels of packages without names.
    """
    if len(paths) == 1 and paths[0].is_dir():
        paths = [find_package(paths[0], Path(capture).name) for capture in captures]
    elif not paths:
        paths = [Path(capture) / "ground_truth.npz" for capture in captures if not Path(capture).is_file()]
        if not paths or not all(path.is_file() for path in paths):
            absent = f"{paths[0]} does not exist" if paths else "no capture holds it"
            raise FreeOccError(
                f"The ground truth is missing, because {absent}: name it with "
                "--ground-truth. 'freeocc3d ground-truth' builds it from a capture with poses."
            )
    if len(paths) != count:
        raise FreeOccError(f"{len(paths)} ground truths are given for {count} scenes: give one for each.")
    names = None if classes is None else ("free", *classes.classes)
    return [load_ground_truth(path, names) for path in paths]


def collect_common_classes(truths: Sequence[GroundTruth]) -> ClassMap:
    """Returns all classes that the truths name, each mapped to itself."""
    names = dict.fromkeys(name for truth in truths for name in truth.classes[1:])
    return map_each_to_itself(("", *names))


@dataclass(frozen=True)
class Evaluation:
    """Scores over all scenes, pooled by voxels. how: "se3", "sim3" or "none".

    mIoU is over the classes that the truth holds. With a class file (``listed``), it is over all classes of the file,
    and absent classes count 0, as in EmbodiedOcc.
    """

    scenes: tuple[ScoredScene, ...]
    classes: tuple[str, ...]
    how: str
    listed: bool = False

    @cached_property
    def by_mask(self) -> dict[str, Scores]:
        """Scores under the mask "label" and, if every scene has masks of its frames, under "frames"."""
        masks = [scene.truth.masks() for scene in self.scenes]
        return {
            name: Scores(
                np.sum(
                    [
                        count_confusion(scene.truth.labels, scene.predicted, own[name], len(self.classes))
                        for scene, own in zip(self.scenes, masks, strict=True)
                    ],
                    axis=0,
                ),
                self.classes,
            )
            for name in masks[0]
            if all(name in own for own in masks)
        }

    @property
    def scores(self) -> Scores:
        """The scores under the primary mask."""
        return self.by_mask[PRIMARY_MASK]

    @property
    def has_classes(self) -> bool:
        """Whether every prediction has classes; without them, there is no mIoU."""
        return all(scene.predicted.labels is not None for scene in self.scenes)

    @property
    def classes_in_miou(self) -> tuple[str, ...]:
        """The classes that mIoU is the mean of."""
        return self.classes if self.listed else self.scores.present

    @property
    def absent(self) -> tuple[str, ...]:
        """Listed classes that the truth does not hold."""
        return tuple(name for name in self.classes if name not in self.scores.present)

    @cached_property
    def miou_over(self) -> dict[str, tuple[str, ...] | None]:
        """The usual lists of classes for mIoU; None for a list that does not fit these classes."""
        known = {name.lower() for name in self.classes}
        lists: dict[str, tuple[str, ...] | None] = {"present": self.scores.present, "listed": self.classes}
        for name, wanted in (("shared_8", SHARED), ("embodiedocc_11", EMBODIEDOCC)):
            fits = known.issuperset(wanted)
            lists[name] = tuple(c for c in self.classes if c.lower() in wanted) if fits else None
        for count in TOP:
            enough = len(self.scores.present) >= count
            lists[f"top_{count}"] = self.scores.most_frequent(count) if enough else None
        return lists

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that a reader of the figures should know."""
        apart = [
            f"{scene.name} has no occupied voxel inside the truth: if they are not in one frame, name true poses in "
            "the truth's frame with --poses."
            for scene in self.scenes
            if not count_confusion(
                scene.truth.labels, scene.predicted, scene.truth.masks()[PRIMARY_MASK], len(self.classes)
            )[:, 1:].any()
        ]
        return tuple(dict.fromkeys([*(note for scene in self.scenes for note in scene.notes), *apart]))

    @property
    def ate_rmse_m(self) -> float | None:
        """Mean ATE over the scenes, meters; None if a scene has no trajectory."""
        errors = [scene.errors.ate_rmse_m for scene in self.scenes if scene.errors is not None]
        return float(np.mean(errors)) if len(errors) == len(self.scenes) else None

    def miou(self, names: Sequence[str] | None = None, mask: str = PRIMARY_MASK) -> float | None:
        """Returns the mean IoU over some classes, by default ``classes_in_miou``; None without predicted classes."""
        names = self.classes_in_miou if names is None else names
        return self.by_mask[mask].miou(names) if self.has_classes and names else None

    @property
    def by_scene(self) -> list[Evaluation]:
        """An evaluation of each scene alone."""
        return [Evaluation((scene,), self.classes, self.how, self.listed) for scene in self.scenes]
