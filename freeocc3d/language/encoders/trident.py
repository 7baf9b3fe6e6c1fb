"""Trident, the paper's encoder: DINO's correlations mix CLIP's values, and SAM gathers and refines them.

Source: Y. Shi et al., Harnessing Vision Foundation Models for High-Performance, Training-Free Open Vocabulary
Segmentation, 2024. Its steps, as implemented here:

1. Splice. In every window the correlation of DINO's patches replaces CLIP's last attention: softmax over j of gamma
   (S_ij - beta mean(S)), with S the cosines, without negative entries. The resulting mixes of CLIP's values are
   averaged over windows.
2. Gather. SAM's last attention (mean over heads) over the whole frame mixes the spliced values, without pairs of
   patches whose SAM features have a smaller cosine than ``cosine`` times the mean. CLIP's projection turns the result
   into features.
3. Refine. The paper prompts SAM with the areas of the classes in the query. A map is built before any query, so here
   the prompts are a grid of points. A pixel gets the mean feature of the masks that cover it, weighted by SAM's
   estimate of their quality.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...core.types import Frame
from ...settings.option_types import Advanced, Device
from .. import model_packages
from ..text_networks import ModelWords
from .base import WELL_COVERED, Encoder
from .model_options import FeatureSpacing, ImageSide, PatchOptions, WindowSide

if TYPE_CHECKING:
    from ..patch_features import Tiling

REQUIRES: tuple[str, ...] = ("onnxruntime", "tokenizers")

_FINER = 2
"""Features per SAM patch along an axis, after refinement."""


class Options(PatchOptions, frozen=True):
    """The models, and the paper's constants."""

    model: str = ""
    """Folder of a model package of kind "clip", or its name in the models folder (see freeocc3d models list)."""
    dino: str = ""
    """The same for kind "backbone": DINO ViT-B/16 in the paper."""
    sam: str = ""
    """The same for kind "sam"."""
    short_side: ImageSide = 336
    window: WindowSide | None = 336
    """Edge in pixels of the windows to encode one by one; they overlap by half. 0 = the whole frame at once; null = the
    size of the model's training images."""
    beta: Advanced[Annotated[float, Meta(ge=-100, le=100)]] = 1.2
    """A pair of DINO patches counts if its correlation exceeds this times the mean correlation."""
    gamma: Advanced[Annotated[float, Meta(ge=-1000, le=1000)]] = 3.0
    """Factor of the correlations in the softmax."""
    cosine: Advanced[Annotated[float, Meta(ge=-100, le=100)]] = 1.2
    """A pair of SAM patches counts if its cosine exceeds this times the mean cosine."""
    points: Advanced[Annotated[int, Meta(ge=0, le=64)]] = 16
    """Number of prompt points for SAM along the longer side of the grid; 0 = no masks."""
    mask_score: Advanced[Annotated[float, Meta(ge=-100, le=100)]] = 0.8
    """Smallest quality of a mask, as SAM estimates it."""
    stride: FeatureSpacing = 4
    """Pixels between features, which are upsampled along the image's edges; 0 = SAM's grid."""
    device: Device = "cpu"
    """Device that runs the image networks: "cpu", or "cuda:0" with onnxruntime-gpu."""


class TridentEncoder(Encoder):
    """CLIP, DINO and SAM together."""

    name: ClassVar[str] = "trident"
    coverage = WELL_COVERED

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
        """(ceil(H / stride), ceil(W / stride), D) float16, or (h, w, D) on SAM's grid, twice as fine with masks."""
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
        """(rows, columns, width) CLIP's values, mixed in each window by DINO's correlation; the mean over windows."""
        from ..patch_features import Splice, Tiling

        options, clip, dino = self.options, self.clip, self.dino
        window = clip.input_size if options.window is None else options.window
        tiling = Tiling.of(rgb.shape[0], rgb.shape[1], clip, options.short_side, window, half_overlap=True)
        same = dataclasses.replace(tiling, patch=dino.patch)  # the same patches at DINO's size
        seen_by_dino = same.windows(same.image(rgb, dino.mean, dino.std))
        splice: Splice | None = None
        for (images, corners), (others, _) in zip(
            tiling.windows(tiling.image(rgb, clip.mean, clip.std)), seen_by_dino, strict=True
        ):
            tokens = tiling.window[0] * tiling.window[1] + clip.prefix_tokens
            (values,) = self._image.run(["values"], {"image": images}, {"values": (len(images), None, tokens, None)})
            own = {"features": (len(images), *tiling.window, None)}
            (seen,) = self._dino.run(["features"], {"image": others}, own)
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

        fed = {"mixed": mixed[None], "stream": np.zeros_like(mixed[None])}
        (features,) = self._head.run(["reduced"], fed, {"reduced": (1, len(mixed), self.dimension)})
        return normalize_patches(features[0])

    def _sam_view(self, rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32], tuple[int, int]]:
        """SAM's features (1, C, n, n), its attention (1, n n, n n), and the (rows, columns) of them that show the
        frame, which is at the upper left of a square."""
        from ..patch_features import Tiling

        size, patch = self.sam.input_size, self.sam.patch
        long, short = max(rgb.shape[:2]), min(rgb.shape[:2])
        tiling = Tiling.of(rgb.shape[0], rgb.shape[1], self.sam, max(patch, round(size * short / long)), 0)
        grid = min(tiling.grid[0], size // patch), min(tiling.grid[1], size // patch)
        tiling = dataclasses.replace(tiling, grid=grid)
        square = np.zeros((1, 3, size, size), np.float32)
        square[0, :, : grid[0] * patch, : grid[1] * patch] = tiling.image(rgb, self.sam.mean, self.sam.std)
        n = size // patch
        shapes = {"features": (1, None, n, n), "attention": (1, n * n, n * n)}
        features, attention = self._sam.run(["features", "attention"], {"image": square}, shapes)
        return features, attention, grid

    def _refined(self, features: NDArray[np.float32], sam_features: NDArray[np.float32]) -> NDArray[np.float32]:
        """(2 h, 2 w, D) features from (h, w, D), averaged within SAM's masks."""
        from ..patch_features import normalize_patches, resample_patches

        h, w = features.shape[:2]
        spacing = max(h, w) / self.options.points * self.sam.patch
        xs, ys = (np.arange(spacing / 2, n * self.sam.patch, spacing, dtype=np.float32) for n in (w, h))
        points = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(1, -1, 2)
        count, n = points.shape[1], sam_features.shape[2]
        shapes = {"masks": (1, count, 3, 4 * n, 4 * n), "scores": (1, count, 3)}
        masks, scores = self._masks.run(["masks", "scores"], {"features": sam_features, "points": points}, shapes)
        best = scores[0].argmax(axis=1)
        rows = np.flatnonzero(scores[0, np.arange(len(best)), best] >= self.options.mask_score)
        finer = normalize_patches(resample_patches(features, (_FINER * h, _FINER * w)))
        fraction = masks.shape[3] // sam_features.shape[2]  # pixels of a mask per SAM patch
        cell = fraction // _FINER
        if not len(rows):
            return finer
        covers = masks[0, rows, best[rows], : h * fraction, : w * fraction] > 0
        shares = covers.reshape(len(rows), _FINER * h, cell, _FINER * w, cell).mean(axis=(2, 4), dtype=np.float32)
        return normalize_patches(pool_masks(finer, shares, scores[0, rows, best[rows]]))

    def text_state(self) -> dict[str, Any]:
        return self.options.wording.state(self.clip)


def correlate_patches(seen: NDArray[np.float32], beta: float, gamma: float) -> NDArray[np.float32]:
    """(N, N) attention from the cosines of (N, C) features. Cosines below beta times their mean give 0; a patch always
    attends to itself."""
    from ..clip_attention import apply_softmax
    from ..patch_features import normalize_patches

    u = normalize_patches(seen)
    cosines = u @ u.T
    logits = np.float32(gamma) * (cosines - np.float32(beta) * cosines.mean())
    masked = logits < 0
    np.fill_diagonal(masked, False)
    return apply_softmax(np.where(masked, np.float32(-np.inf), logits).astype(np.float32))


def gate_attention(attention: NDArray[np.float32], seen: NDArray[np.float32], cosine: float) -> NDArray[np.float32]:
    """(N, N) attention without pairs of patches whose (N, C) features have a smaller cosine than ``cosine`` times the
    mean; rows sum to 1."""
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
    """(h, w, D) the mean over masks of their mean features, weighted by the score of each mask and its share (M, h, w)
    of the cell. A cell without masks keeps its own feature."""
    flat, own = shares.reshape(len(shares), -1), features.reshape(-1, features.shape[-1])
    sizes = flat.sum(axis=1, keepdims=True)
    means = (flat @ own) / np.where(sizes > 0, sizes, 1)
    weights = flat * scores[:, None]
    total = weights.sum(axis=0)[:, None]
    mixed = (weights.T @ means) / np.where(total > 0, total, 1)
    return np.asarray(np.where(total > 0, mixed, own).reshape(features.shape))


NEEDS_CAPTURE = False
"""Encoding keyframes again needs only the keyframes."""


def check(options: Options) -> tuple[model_packages.Package, model_packages.Package, model_packages.Package]:
    """Finds the models that the options name: CLIP, DINO and SAM. Raises ModelError if one does not exist."""
    return (
        model_packages.find_model(options.model, ("clip",), "language.trident.model"),
        model_packages.find_model(options.dino, ("backbone",), "language.trident.dino"),
        model_packages.find_model(options.sam, ("sam",), "language.trident.sam"),
    )


def load(options: Options, capture: object = None) -> TridentEncoder:
    """Makes the encoder; it needs nothing from the capture. Raises ModelError."""
    return TridentEncoder(*check(options), options)


def load_text(state: dict[str, Any]) -> ModelWords:
    """Restores the text part, CLIP's; it looks for the text network when it first encodes a word."""
    return ModelWords(state)
