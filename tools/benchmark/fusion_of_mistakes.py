"""How far layer 3 corrects mistakes in class images: mIoU after fusing images with flipped regions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .figures import Figures, tabulate
from .true_frame import put_gaussians_in_world, put_keyframes_in_world

FLIPPED, SEEDS, CELL_PX = 0.2, (0, 1, 2), 48
KINDS = ("superpixels", "components")
"""Regions whose label is flipped: the parts that a jittered grid of ``CELL_PX`` cuts each class into, or its connected
components."""


def measure_fusion(map_path: str) -> Figures:
    """mIoU of a map of class images, the mIoU of the nearest true labels at the same voxels, and the mIoU when a share
    of each keyframe's regions shows a random class: ours, plain averages, the last keyframe's label."""
    from freeocc3d.language.encoders.labels import LabelsEncoder
    from freeocc3d.query.scan_map import load_map

    scan_map = load_map(map_path)
    capture = scan_map.capture
    scene = Scene(scan_map, Path(scan_map.manifest.capture.path) / "ground_truth.npz")

    def encoder(kind: str | None, seed: int) -> LabelsEncoder:
        images = capture.labels if kind is None else Flipped(capture.labels, len(capture.classes), kind, seed)
        return LabelsEncoder(tuple(capture.classes), images)

    found: Figures = {"nearest_true_label": scene.ceiling, "clean": scene.fused(encoder(None, 0))}
    for kind in KINDS:
        found[kind] = [scene.fused(encoder(kind, seed)) for seed in SEEDS]
    return found


class Flipped:
    """Class images in which a random share of the regions is relabeled to another class."""

    def __init__(self, images: Any, classes: int, kind: str, seed: int):
        self.images, self.classes, self.kind, self.seed = images, classes, kind, seed

    def __call__(self, index: int) -> Any:
        import numpy as np

        image, rng = self.images(index), np.random.default_rng((self.seed, index))
        if image is None:
            return None
        region = _superpixels(image, rng) if self.kind == "superpixels" else _components(image)
        own = np.zeros(int(region.max()) + 1, np.int64)
        own[region.ravel()] = image.ravel()
        other = rng.integers(1, self.classes - 1, len(own))
        other += other >= np.maximum(own, 1)  # any class but its own
        return np.where(rng.random(len(own)) < FLIPPED, other, own)[region].astype(np.uint8)


def _superpixels(image: Any, rng: Any) -> Any:
    """Numbers of the parts that Voronoi cells of a jittered grid cut the classes into."""
    import numpy as np
    from scipy.spatial import cKDTree

    height, width = image.shape
    rows, columns = np.mgrid[CELL_PX / 2 : height : CELL_PX, CELL_PX / 2 : width : CELL_PX]
    grid = np.stack((rows, columns), axis=-1).reshape(-1, 2)
    seeds = grid + rng.uniform(-CELL_PX / 2, CELL_PX / 2, grid.shape)
    cell = cKDTree(seeds).query(np.indices(image.shape).reshape(2, -1).T)[1]
    return np.unique(cell * 256 + image.ravel(), return_inverse=True)[1].reshape(image.shape)


def _components(image: Any) -> Any:
    """Numbers of the connected components of the classes."""
    import cv2
    import numpy as np

    out, count = np.zeros(image.shape, np.int64), 0
    for k in np.unique(image):
        parts, part = cv2.connectedComponents((image == k).astype(np.uint8), connectivity=4)
        out[part > 0] = part[part > 0] + count - 1
        count += parts - 1
    return out


class Scene:
    """A map's Gaussians on its truth's lattice, scored with other features than its own."""

    def __init__(self, scan_map: Any, truth_path: Path):
        import numpy as np
        from scipy.spatial import cKDTree

        from freeocc3d.core.types import OCCUPIED, UNKNOWN
        from freeocc3d.evaluation import scoring
        from freeocc3d.evaluation.ground_truth import load_ground_truth
        from freeocc3d.occupancy import build, splat
        from freeocc3d.settings import config

        settings = config.load_saved(scan_map.path / "config.yaml")
        self.options = settings.language
        self.truth = load_ground_truth(truth_path)
        self.classes = scoring.collect_common_classes([self.truth])
        self.words = scan_map.text_encoder.encode_words(list(self.truth.classes[1:]))
        self.gaussians, self.scan_map = put_gaussians_in_world(scan_map), scan_map
        labels = self.truth.labels
        self.present = np.unique(labels[(labels > 0) & (labels != UNKNOWN)])
        made = build.build_occupancy(
            self.gaussians,
            np.zeros((len(self.gaussians), 0), np.float16),
            put_keyframes_in_world(scan_map),
            settings.occupancy.changed(voxel_size=self.truth.voxel_size),
            settings.carving,
            origin=self.truth.origin,
        )
        voxels = made.voxels(OCCUPIED)
        self.inside = ((voxels >= 0) & (voxels < self.truth.shape)).all(axis=1)
        self.at = tuple(voxels[self.inside].T)
        self.bins = splat.bin_gaussians(self.gaussians, self.truth.origin, splat.Options(self.truth.voxel_size))
        self.slots = _slots(made, self.bins)
        true = np.argwhere((labels > 0) & (labels != UNKNOWN))
        nearest = true[cKDTree(true).query(voxels[self.inside])[1]]
        self.ceiling = self.miou(labels[tuple(nearest.T)])

    def fused(self, encoder: Any) -> Figures:
        """mIoU by method of fusion."""
        import numpy as np

        from freeocc3d.language.feature_fusion import FeatureFusion
        from freeocc3d.language.visibility import find_visible

        count = len(self.gaussians)
        ours = FeatureFusion(count, encoder.dimension, self.options.disagreement)
        mean, last = FeatureFusion(count, encoder.dimension), np.zeros((count, encoder.dimension), np.float16)
        for frame, T, _ in put_keyframes_in_world(self.scan_map):
            shown, features = find_visible(self.gaussians, frame, T, self.options), encoder.encode(frame)
            ours.add(shown, features)
            mean.add(shown, features)
            own = features.reshape(-1, encoder.dimension)[shown.cells(features.shape[:2])]
            says = own.any(axis=1)
            last[shown.rows[says]] = own[says]
        return {"ours": self.score(ours.features()), "mean": self.score(mean.features()), "last": self.score(last)}

    def score(self, features: Any) -> float:
        """mIoU, over the present classes, of the words nearest to the voxels."""
        import numpy as np

        from freeocc3d.core.voxel_keys import unpack_voxels
        from freeocc3d.occupancy import build, splat
        from freeocc3d.query import word_query

        means = splat.compute_posterior_mean(self.bins, unpack_voxels(self.bins.packed), self.slots, features)
        nearest = word_query.nearest_word(build.normalize_rows(means)[self.inside], self.words)
        return self.miou((nearest + 1).astype(np.uint8))

    def miou(self, labels: Any) -> float:
        import numpy as np

        from freeocc3d.evaluation.confusion import Prediction, Scores, count_confusion

        predicted, occupied = np.zeros(self.truth.shape, np.uint8), np.zeros(self.truth.shape, bool)
        predicted[self.at], occupied[self.at] = labels, True
        names = self.classes.classes
        scores = Scores(
            count_confusion(
                self.truth.labels, Prediction(occupied, predicted), self.truth.masks()["label"], len(names)
            ),
            names,
        )
        return scores.miou(scores.present)


def _slots(occupancy: Any, bins: Any) -> Any:
    """(B, 512) row of each occupied voxel in the bins' blocks."""
    import numpy as np

    from freeocc3d.core.types import OCCUPIED
    from freeocc3d.core.voxel_keys import pack_voxels

    occupied = occupancy.state == OCCUPIED
    slots = np.full(occupied.shape, -1, np.int32)
    slots[occupied] = np.arange(np.count_nonzero(occupied))
    return slots[np.searchsorted(pack_voxels(occupancy.keys), bins.packed)]


def tabulate_fusion(measured: list[Figures]) -> list[str]:
    """A table of mIoU, a row for each capture and kind of flips."""
    rows = []
    for found in measured:
        capture = found["capture"]
        if "error" in found:
            rows.append([capture, f"not available, {found['error']}", "–", "–", "–", "–"])
            continue
        for kind in ("clean", *KINDS):
            runs = found[kind] if isinstance(found[kind], list) else [found[kind]]
            cells = [" / ".join(f"{100 * run[way]:.1f}" for run in runs) for way in ("ours", "mean", "last")]
            rows.append([capture, kind, f"{100 * found['nearest_true_label']:.1f}", *cells])
    return tabulate(
        ["capture", f"{100 * FLIPPED:.0f} % flipped", "nearest true label", "mIoU ours", "mean", "last keyframe"], rows
    )
