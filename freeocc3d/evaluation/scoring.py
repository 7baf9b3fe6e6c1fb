"""Scenes scored one by one and pooled: what ``freeocc3d evaluate`` does.

The result states which classes are scored, under which masks, and what could not be scored: no figure stands without
them.
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
    """What is to be scored: maps, or one of ``gaussians``, ``grid`` and ``frames``, as on the command line.

    ground_truths: one for each map, or one folder of packages, or none: the captures' own ``ground_truth.npz``.
    poses: one for each map, or none: the captures' own.  classes: a class file.  split: a file that lists the scenes to
    score.  overrides: options of layer 4.  align: se3, sim3 or none; None = se3, and sim3 if a map's scale is unknown.
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
    """Read what is asked for, score each scene, pool. Raises FreeOccError with one sentence about what does not fit."""
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
            f"--poses is given {len(asked.poses)} times for {count} scenes: once for each, or not at all."
        )
    poses: list[Poses | None] = [read_poses(path) for path in asked.poses] or [None] * count
    classes = listed or collect_common_classes(truths)
    truths = [classes.apply(truth, str(asked.classes)) for truth in truths]
    trajectory = None if asked.trajectory is None else read_poses(asked.trajectory)
    for other in (asked.gaussians, asked.grid, asked.frames):
        if other is not None and not other.exists():
            raise FreeOccError(f"There is no {other} to score.")
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
            raise FreeOccError("Per-frame Gaussians are fused by true poses: name them with --poses.")
        scenes = [score_frames(asked.frames, truths[0], classes, poses[0], asked.overrides)]
    else:
        raise FreeOccError("There is nothing to score: give a map, or --gaussians, --grid or --frames.")
    return Evaluation(tuple(scenes), classes.classes, how, listed is not None)


def name_scene(scan_map: Map) -> str:
    """A map's scene: the name of the capture's folder."""
    return Path(scan_map.manifest.capture.path).name


def _in_split(maps: list[Map], split: Path) -> list[Map]:
    """The maps of the scenes that a split lists, in its order. Raises FreeOccError if one is missing."""
    by_name = {name_scene(scan_map): scan_map for scan_map in maps}
    scenes = read_split(split)
    missing = [name for name in scenes if name not in by_name]
    if missing:
        raise FreeOccError(
            f"{split} lists {len(missing)} scenes of which no map is given, the first is {missing[0]}: a score over "
            "part of a split is not that split's."
        )
    return [by_name[name] for name in scenes]


def _truths(captures: Sequence[str], paths: Sequence[Path], count: int, classes: ClassMap | None) -> list[GroundTruth]:
    """The truth of each scene. captures: their folders, whose own truths are taken if no paths are given.

    classes: the class file's, which names the labels of packages that do not.
    """
    if len(paths) == 1 and paths[0].is_dir():
        paths = [find_package(paths[0], Path(capture).name) for capture in captures]
    elif not paths:
        paths = [Path(capture) / "ground_truth.npz" for capture in captures if not Path(capture).is_file()]
        if not paths or not all(path.is_file() for path in paths):
            absent = f"there is no {paths[0]}" if paths else "no capture is named that could bring it"
            raise FreeOccError(f"The truth is lacking, {absent}: name it with --ground-truth.")
    if len(paths) != count:
        raise FreeOccError(f"{len(paths)} ground truths are given for {count} scenes: give one for each.")
    names = None if classes is None else ("free", *classes.classes)
    return [load_ground_truth(path, names) for path in paths]


def collect_common_classes(truths: Sequence[GroundTruth]) -> ClassMap:
    """All classes that some truths name, each for itself."""
    names = dict.fromkeys(name for truth in truths for name in truth.classes[1:])
    return map_each_to_itself(("", *names))


@dataclass(frozen=True)
class Evaluation:
    """Scores over all scenes, pooled by voxels. how: "se3", "sim3" or "none".

    Which classes make up mIoU: those that the truth holds, or, where a class file was given (``listed``), all that it
    lists, as EmbodiedOcc counts them, absent ones as 0.
    """

    scenes: tuple[ScoredScene, ...]
    classes: tuple[str, ...]
    how: str
    listed: bool = False

    @cached_property
    def by_mask(self) -> dict[str, Scores]:
        """Scores under "label" and, where every scene has masks of its frames, under "frames"."""
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
        """Under the primary mask."""
        return self.by_mask[PRIMARY_MASK]

    @property
    def has_classes(self) -> bool:
        """Whether every claim names classes; without, there is no mIoU."""
        return all(scene.predicted.labels is not None for scene in self.scenes)

    @property
    def classes_in_miou(self) -> tuple[str, ...]:
        """The classes whose mean is mIoU."""
        return self.classes if self.listed else self.scores.present

    @property
    def absent(self) -> tuple[str, ...]:
        """Listed classes that the truth does not hold."""
        return tuple(name for name in self.classes if name not in self.scores.present)

    @cached_property
    def miou_over(self) -> dict[str, tuple[str, ...] | None]:
        """Lists of classes over which mIoU is usually given; None for one that does not apply to these classes."""
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
        """What should be known when the figures are read."""
        apart = [
            f"{scene.name} claims no voxel inside the truth: if they are not in one frame, name true poses in the "
            "truth's frame with --poses."
            for scene in self.scenes
            if not count_confusion(
                scene.truth.labels, scene.predicted, scene.truth.masks()[PRIMARY_MASK], len(self.classes)
            )[:, 1:].any()
        ]
        return tuple(dict.fromkeys([*(note for scene in self.scenes for note in scene.notes), *apart]))

    @property
    def ate_rmse_m(self) -> float | None:
        """Mean over the scenes, None where one has no trajectory."""
        errors = [scene.errors.ate_rmse_m for scene in self.scenes if scene.errors is not None]
        return float(np.mean(errors)) if len(errors) == len(self.scenes) else None

    def miou(self, names: Sequence[str] | None = None, mask: str = PRIMARY_MASK) -> float | None:
        """Mean IoU over some classes, by default ``classes_in_miou``; None where no classes were claimed."""
        names = self.classes_in_miou if names is None else names
        return self.by_mask[mask].miou(names) if self.has_classes and names else None

    @property
    def by_scene(self) -> list[Evaluation]:
        """Each scene alone."""
        return [Evaluation((scene,), self.classes, self.how, self.listed) for scene in self.scenes]
