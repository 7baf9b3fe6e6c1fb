"""Mask classification, as in SEEM, X-Decoder or Mask2Former, as a model package: masks with a meaning in words.

Such a network gives Q masks m_q, each with an embedding e_q in the space of words. Mask classification assigns a pixel
to a class by sum_q p(class | e_q) sigmoid(m_q) (Cheng et al., MaskFormer, NeurIPS 2021, sec. 3.4). Here the classes are
not yet known, so a pixel gets the embedding of the mask that covers it best.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...core.errors import ModelError
from ...core.types import Frame
from .. import model_packages
from ..text_networks import ModelWords
from .base import WELL_COVERED, Encoder
from .model_options import ImageSide, WordOptions

REQUIRES: tuple[str, ...] = ("onnxruntime", "tokenizers")


class Options(WordOptions, frozen=True):
    """The model, and which of its masks count."""

    model: str = ""
    """Folder of a model package of kind "masks", or its name in the models folder (see freeocc3d models list)."""
    short_side: ImageSide = 512
    """Frames are resized to this many pixels on the shorter side, and both sides to whole patches."""
    mask_probability: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    """A pixel has a feature only if a mask covers it with at least this probability."""


class SeemEncoder(Encoder):
    """The embedding of the mask that covers a pixel best."""

    name: ClassVar[str] = "seem"
    coverage = WELL_COVERED

    def __init__(self, package: model_packages.Package, options: Options):
        self.package = package
        self.options = options
        self.dimension = package.dimension
        self._image = package.session("image", options.device)

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(h, w, D) float16 at the resolution of the masks; zero where no mask is sure."""
        from ..patch_features import Tiling

        package, rgb = self.package, frame.color
        tiling = Tiling.of(rgb.shape[0], rgb.shape[1], package, self.options.short_side, 0)
        image = tiling.image(rgb, package.mean, package.std)[None]
        shapes = {"masks": (1, None, None, None), "embeddings": (1, None, self.dimension)}
        masks, embeddings = self._image.run(["masks", "embeddings"], {"image": image}, shapes)
        if len(masks[0]) != len(embeddings[0]) or not masks.size:
            raise ModelError(
                f"{self._image.path} gives masks {masks.shape} and embeddings {embeddings.shape}, which do not fit "
                "each other: export it again."
            )
        return paint_masks(masks[0], embeddings[0], self.options.mask_probability)

    def text_state(self) -> dict[str, Any]:
        return self.options.wording.state(self.package)


def paint_masks(
    masks: NDArray[np.float32], embeddings: NDArray[np.float32], least_probability: float
) -> NDArray[np.float16]:
    """(h, w, D) the unit embedding of the mask that covers each pixel best, from (Q, h, w) logits; zero where none
    does."""
    from ..patch_features import normalize_patches

    best = masks.argmax(axis=0)
    features = normalize_patches(embeddings).astype(np.float16)[best]
    features[masks.max(axis=0) < np.log(least_probability / (1 - least_probability))] = 0
    return features


NEEDS_CAPTURE = False
"""Encoding keyframes again needs only the keyframes."""


def check(options: Options) -> model_packages.Package:
    """Finds the model that the options name. Raises ModelError if it does not exist."""
    return model_packages.find_model(options.model, ("masks",), "language.seem.model")


def load(options: Options, capture: object = None) -> SeemEncoder:
    """Makes the encoder; it needs nothing from the capture. Raises ModelError."""
    return SeemEncoder(check(options), options)


def load_text(state: dict[str, Any]) -> ModelWords:
    """Restores the text part; it looks for the text network when it first encodes a word."""
    return ModelWords(state)
