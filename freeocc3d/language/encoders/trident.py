"""Trident, the paper's encoder: CLIP's values mixed by DINO's correlation, gathered and refined by SAM.

Source: Y. Shi et al., Harnessing Vision Foundation Models for High-Performance, Training-Free Open Vocabulary
Segmentation, 2024. Its steps, as they are here:

1. Splice. In every window CLIP's last attention is replaced by the correlation of DINO's patches,
   softmax over j of gamma (S_ij - beta mean(S)), S the cosines, without those that are negative; what it makes of
   CLIP's values is averaged over windows.
2. Gather. SAM's last attention (mean over heads) over the whole frame mixes the spliced values, without pairs of
   patches whose SAM features are less alike than ``cosine`` times the mean; CLIP's projection makes features of them.
3. Refine. The paper prompts SAM with what each class asked for covers. A map is built before anybody asks, so that the
   prompts are a grid of points here, and a pixel takes the mean feature of the masks that cover it, each weighing by
   SAM's estimate of its quality.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...core.types import Frame
from ...settings.option_types import Advanced, Finite, NotNegativeInt
from .. import model_packages
from ..text_networks import ModelWords
from .base import Encoder
from .model_options import PatchOptions, WindowSide

if TYPE_CHECKING:
    from ..patch_features import Tiling

REQUIRES: tuple[str, ...] = ("onnxruntime", "tokenizers")

_FINER = 2
"""Features a patch of SAM's, along an axis, after refinement."""


class Options(PatchOptions, frozen=True):
    """Which models, and the paper's constants."""

    model: str = ""
    """Folder of a model package of kind "clip", or its name in the models folder (freeocc3d models list)."""
    dino: str = ""
    """The same of kind "backbone": DINO ViT-B/16 in the paper."""
    sam: str = ""
    """The same of kind "sam"."""
    window: WindowSide | None = 336
    beta: Advanced[Finite] = 1.2
    """Share of the mean correlation that a pair of DINO's patches must exceed."""
    gamma: Advanced[Finite] = 3.0
    """Factor of correlations in the softmax."""
    cosine: Advanced[Finite] = 1.2
    """Share of the mean cosine that a pair of SAM's patches must exceed."""
    points: Advanced[Annotated[int, Meta(ge=0, le=64)]] = 16
    """Points along the longer side of the grid that SAM is prompted with; 0 = no masks."""
    mask_score: Advanced[Finite] = 0.8
    """Least quality of a mask, as SAM estimates it."""
    stride: NotNegativeInt = 4
    """Pixels of the frame from one feature to the next, upsampled along the image's edges; 0 = as SAM's grid is."""
    device: str = "cpu"
    """Where the image networks run: "cpu", or "cuda:0" with onnxruntime-gpu."""


class TridentEncoder(Encoder):
    """CLIP, DINO and SAM together."""

    name: ClassVar[str] = "trident"

    def __init__(
        self, clip: model_packages.Package, dino: model_packages.Package, sam: model_packages.Package, options: Options
    ):
        self.clip, self.dino, self.sam = clip, dino, sam
        self.options = options
        self.dimension = clip.dimension
        self._image, self._head = (clip.session(part, options.device) for part in ("image", "head"))
        self._dino = dino.session("image", options.device)
        self._sam, self._masks = (sam.session(part, options.device) for part in ("image", "masks"))

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(ceil(H / stride), ceil(W / stride), D) float16, or (h, w, D) at SAM's grid, twice as fine with masks."""
        from ..patch_features import finish_patches, resample_patches

        rgb = frame.color
        spliced = self.spliced(rgb)
        sam_features, attention, grid = self._sam_view(rgb)
        seen = sam_features[0, :, : grid[0], : grid[1]].reshape(sam_features.shape[1], -1).T
        side = sam_features.shape[3]
        inside = (np.arange(grid[0])[:, None] * side + np.arange(grid[1])).ravel()
        weights = gate_attention(attention[0][np.ix_(inside, inside)], seen, self.options.cosine)
        gathered = weights @ resample_patches(spliced, grid).reshape(len(inside), -1)
        features = self._in_words(gathered).reshape(*grid, -1)
        if self.options.points:
            features = self._refined(features, sam_features)
        return finish_patches(features, rgb, self.options.stride)

    def spliced(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(rows, columns, width) CLIP's values, mixed by DINO's correlation in each window; the windows' mean."""
        from ..patch_features import Splice, Tiling

        options, clip, dino = self.options, self.clip, self.dino
        window = clip.input_size if options.window is None else options.window
        tiling = Tiling.of(rgb.shape[0], rgb.shape[1], clip, options.short_side, window)
        same = dataclasses.replace(tiling, patch=dino.patch)  # the same patches, as large as DINO wants them
        seen_by_dino = same.windows(same.image(rgb, dino.mean, dino.std))
        splice: Splice | None = None
        for (images, corners), (others, _) in zip(
            tiling.windows(tiling.image(rgb, clip.mean, clip.std)), seen_by_dino, strict=True
        ):
            (values,) = self._image.run(["values"], {"image": images})
            (seen,) = self._dino.run(["features"], {"image": others})
            mixed = self._mixed(values, seen, tiling)
            splice = splice or Splice(tiling, mixed.shape[-1])
            splice.add(mixed, corners)
        assert splice is not None  # there is at least one window
        return splice.mean()

    def _mixed(self, values: NDArray[np.float32], seen: NDArray[np.float32], tiling: Tiling) -> NDArray[np.float32]:
        from ..clip_attention import join_heads

        h, w = tiling.window
        patches = join_heads(values)[:, -h * w :]
        flat = seen.reshape(len(seen), h * w, -1)
        weights = np.stack([correlate_patches(own, self.options.beta, self.options.gamma) for own in flat])
        return np.asarray((weights @ patches).reshape(len(seen), h, w, -1))

    def _in_words(self, mixed: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N, D) unit features of (N, width) mixed values."""
        from ..patch_features import normalize_patches

        (features,) = self._head.run(["reduced"], {"mixed": mixed[None], "stream": np.zeros_like(mixed[None])})
        return normalize_patches(features[0])

    def _sam_view(self, rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32], tuple[int, int]]:
        """SAM's features (1, C, n, n), attention (1, n n, n n), and the (rows, columns) of them that show the frame: it
        lies at the upper left of a square."""
        from ..patch_features import Tiling

        size, patch = self.sam.input_size, self.sam.patch
        long, short = max(rgb.shape[:2]), min(rgb.shape[:2])
        tiling = Tiling.of(rgb.shape[0], rgb.shape[1], self.sam, max(patch, round(size * short / long)), 0)
        grid = min(tiling.grid[0], size // patch), min(tiling.grid[1], size // patch)
        tiling = dataclasses.replace(tiling, grid=grid)
        square = np.zeros((1, 3, size, size), np.float32)
        square[0, :, : grid[0] * patch, : grid[1] * patch] = tiling.image(rgb, self.sam.mean, self.sam.std)
        features, attention = self._sam.run(["features", "attention"], {"image": square})
        return features, attention, grid

    def _refined(self, features: NDArray[np.float32], sam_features: NDArray[np.float32]) -> NDArray[np.float32]:
        """(2 h, 2 w, D) features of (h, w, D), brought together within SAM's masks."""
        from ..patch_features import normalize_patches, resample_patches

        h, w = features.shape[:2]
        spacing = max(h, w) / self.options.points * self.sam.patch
        xs, ys = (np.arange(spacing / 2, n * self.sam.patch, spacing, dtype=np.float32) for n in (w, h))
        points = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(1, -1, 2)
        masks, scores = self._masks.run(["masks", "scores"], {"features": sam_features, "points": points})
        best = scores[0].argmax(axis=1)
        rows = np.flatnonzero(scores[0, np.arange(len(best)), best] >= self.options.mask_score)
        finer = normalize_patches(resample_patches(features, (_FINER * h, _FINER * w)))
        fraction = masks.shape[3] // sam_features.shape[2]  # pixels of a mask in a patch of SAM's
        cell = fraction // _FINER
        if not len(rows):
            return finer
        covers = masks[0, rows, best[rows], : h * fraction, : w * fraction] > 0
        shares = covers.reshape(len(rows), _FINER * h, cell, _FINER * w, cell).mean(axis=(2, 4), dtype=np.float32)
        return normalize_patches(pool_masks(finer, shares, scores[0, rows, best[rows]]))

    def text_state(self) -> dict[str, Any]:
        return self.options.wording.state(self.clip)


def correlate_patches(seen: NDArray[np.float32], beta: float, gamma: float) -> NDArray[np.float32]:
    """(N, N) attention from the cosines of (N, C) features: those below beta times their mean get nothing; a patch
    always attends to itself."""
    from ..clip_attention import apply_softmax
    from ..patch_features import normalize_patches

    u = normalize_patches(seen)
    cosines = u @ u.T
    logits = np.float32(gamma) * (cosines - np.float32(beta) * cosines.mean())
    masked = logits < 0
    np.fill_diagonal(masked, False)
    return apply_softmax(np.where(masked, np.float32(-np.inf), logits).astype(np.float32))


def gate_attention(attention: NDArray[np.float32], seen: NDArray[np.float32], cosine: float) -> NDArray[np.float32]:
    """(N, N) attention without the pairs of patches whose (N, C) features are less alike than ``cosine`` times the
    mean, rows summing to 1."""
    from ..patch_features import normalize_patches

    u = normalize_patches(seen)
    cosines = u @ u.T
    kept = cosines >= np.float32(cosine) * cosines.mean()
    np.fill_diagonal(kept, True)
    weights = attention * kept
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def pool_masks(
    features: NDArray[np.float32], shares: NDArray[np.float32], scores: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(h, w, D): the mean over masks of their mean feature, a mask weighing by its score and by its share (M, h, w) of
    the cell; what no mask covers keeps its own."""
    flat, own = shares.reshape(len(shares), -1), features.reshape(-1, features.shape[-1])
    sizes = flat.sum(axis=1, keepdims=True)
    means = (flat @ own) / np.where(sizes > 0, sizes, 1)
    weights = flat * scores[:, None]
    total = weights.sum(axis=0)[:, None]
    mixed = (weights.T @ means) / np.where(total > 0, total, 1)
    return np.asarray(np.where(total > 0, mixed, own).reshape(features.shape))


NEEDS_CAPTURE = False
"""The keyframes alone are enough to encode them again."""


def check(options: Options) -> tuple[model_packages.Package, model_packages.Package, model_packages.Package]:
    """The models that are named: CLIP, DINO and SAM. Raises ModelError if one is not there."""
    return (
        model_packages.find_model(options.model, ("clip",), "language.trident.model"),
        model_packages.find_model(options.dino, ("backbone",), "language.trident.dino"),
        model_packages.find_model(options.sam, ("sam",), "language.trident.sam"),
    )


def load(options: Options, capture: object = None) -> TridentEncoder:
    """The encoder; it needs nothing of the capture. Raises ModelError."""
    return TridentEncoder(*check(options), options)


def load_text(state: dict[str, Any]) -> ModelWords:
    """The word side, CLIP's; the text network is looked for when a word is encoded."""
    return ModelWords(state)
