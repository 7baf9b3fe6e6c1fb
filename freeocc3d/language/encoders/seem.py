"""Mask classification, as of SEEM, X-Decoder or Mask2Former, as a model package: masks that words name.

Such a network gives Q masks m_q with an embedding e_q each, in the space of words. Mask classification assigns a pixel
to a class by sum_q p(class | e_q) sigmoid(m_q) (Cheng et al., MaskFormer, NeurIPS 2021, sec. 3.4); where the classes
are not known yet, a pixel is given the embedding of the mask that covers it best.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...core.types import Frame
from .. import model_packages
from ..text_networks import ModelWords
from .base import Encoder
from .model_options import ImageSide, WordOptions

REQUIRES: tuple[str, ...] = ("onnxruntime", "tokenizers")


class Options(WordOptions, frozen=True):
    """Which model, and which of its masks count."""

    model: str = ""
    """Folder of a model package of kind "masks", or its name in the models folder (freeocc3d models list)."""
    short_side: ImageSide = 512
    """Frames are resized so that their shorter side has this many pixels, and both sides whole patches."""
    mask_probability: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    """Pixels that no mask covers with at least this probability say nothing."""


class SeemEncoder(Encoder):
    """The embedding of the mask that covers a pixel best."""

    name: ClassVar[str] = "seem"

    def __init__(self, package: model_packages.Package, options: Options):
        self.package = package
        self.options = options
        self.dimension = package.dimension
        self._image = package.session("image", options.device)

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(h, w, D) float16, at the masks' resolution; zero where no mask is sure."""
        from ..patch_features import Tiling

        package, rgb = self.package, frame.color
        tiling = Tiling.of(rgb.shape[0], rgb.shape[1], package, self.options.short_side, 0)
        image = tiling.image(rgb, package.mean, package.std)[None]
        masks, embeddings = self._image.run(["masks", "embeddings"], {"image": image})
        return paint_masks(masks[0], embeddings[0], self.options.mask_probability)

    def text_state(self) -> dict[str, Any]:
        return self.options.wording.state(self.package)


def paint_masks(
    masks: NDArray[np.float32], embeddings: NDArray[np.float32], least_probability: float
) -> NDArray[np.float16]:
    """(h, w, D) unit embeddings of the masks, (Q, h, w) logits, that cover each pixel best; zero where none does."""
    from ..patch_features import normalize_patches

    best = masks.argmax(axis=0)
    features = normalize_patches(embeddings).astype(np.float16)[best]
    features[masks.max(axis=0) < np.log(least_probability / (1 - least_probability))] = 0
    return features


NEEDS_CAPTURE = False
"""The keyframes alone are enough to encode them again."""


def check(options: Options) -> model_packages.Package:
    """The model that is named. Raises ModelError if it is not there."""
    return model_packages.find_model(options.model, ("masks",), "language.seem.model")


def load(options: Options, capture: object = None) -> SeemEncoder:
    """The encoder; it needs nothing of the capture. Raises ModelError."""
    return SeemEncoder(check(options), options)


def load_text(state: dict[str, Any]) -> ModelWords:
    """The word side; the text network is looked for when a word is encoded."""
    return ModelWords(state)
