"""Any CLIP or SigLIP ViT as a model package: dense features by another attention in the last block, any words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...core.errors import ConfigError
from ...core.types import Frame
from .. import model_packages
from ..text_networks import CONTRAST, TEMPLATES, ModelWords, Wording
from .base import Encoder, require_sizes

if TYPE_CHECKING:
    from ..patch_features import Tiling

REQUIRES: tuple[str, ...] = ("onnxruntime", "tokenizers")

ATTENTIONS = ("plain", "maskclip", "sclip", "clearclip", "naclip")


@dataclass(frozen=True)
class Options:
    """Which model, and how its patches become features of pixels."""

    model: str = ""
    """Folder of a model package of kind "clip", or its name in the models folder (freeocc3d models list)."""
    attention: str = "naclip"
    """Last block's attention: "plain", "maskclip", "sclip", "clearclip" or "naclip", the best by the papers' tables."""
    short_side: int = 336
    """Frames are resized so that their shorter side has so many pixels."""
    window: int | None = None
    """Edge in pixels of windows that are encoded one by one, half overlapping; 0 = the whole frame at once; null = the
    size of the model's training images."""
    stride: int = 4
    """Pixels of the frame from one feature to the next, upsampled from patches along the image's edges; 0 = patches."""
    templates: tuple[str, ...] = ()
    """Prompts whose mean stands for a word, which goes where they have {}; none = the built-in ones."""
    contrast: tuple[str, ...] = ()
    """Words that a voxel could be instead: a word matches only where none of them fits better; none = what most rooms
    hold."""
    threshold: float = 0.15
    """Least cosine of a match; those of CLIP's images and words lie between 0.1 and 0.35, SigLIP's from 0 to 0.2."""
    device: str = "cpu"
    """Where the image network runs: "cpu", or "cuda:0" with onnxruntime-gpu."""

    def __post_init__(self) -> None:
        if self.attention not in ATTENTIONS:
            raise ConfigError(f"'attention' must be one of {', '.join(ATTENTIONS)}, got {self.attention}.")
        require_sizes(self.short_side, self.window, self.stride)
        self.wording.check()

    @property
    def wording(self) -> Wording:
        """How words are asked."""
        return Wording(self.templates or TEMPLATES, self.contrast or CONTRAST, self.threshold)


class ClipEncoder(Encoder):
    """Patch features in the space of words, spliced from windows, upsampled along the image's edges."""

    name: ClassVar[str] = "clip"

    def __init__(self, package: model_packages.Package, options: Options):
        self.package = package
        self.options = options
        self.dimension = package.dimension
        self._image, self._head = (package.session(part, options.device) for part in ("image", "head"))

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(ceil(H / stride), ceil(W / stride), D) float16, or (rows, columns, D) of patches."""
        from ..patch_features import finish_patches

        return finish_patches(self.patches(frame.color), frame.color, self.options.stride)

    def patches(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(rows, columns, D) unit features of the patches of (H, W, 3) pixels."""
        from ..patch_features import encode_windows

        options = self.options
        return encode_windows(rgb, self.package, options.short_side, options.window, self._window_features)

    def _window_features(self, images: NDArray[np.float32], tiling: Tiling) -> NDArray[np.float32]:
        """(B, h, w, D) of (B, 3, H, W) windows."""
        from .. import clip_attention

        chosen = self.options.attention
        q, k, v, stream = self._image.run(["queries", "keys", "values", "stream"], {"image": images})
        mixed = clip_attention.mix_values(chosen, q, k, v, tiling.window)
        output = "features" if clip_attention.KEEPS_REST[chosen] else "reduced"
        (features,) = self._head.run([output], {"mixed": mixed, "stream": stream})
        h, w = tiling.window
        return np.asarray(features[:, -h * w :].reshape(len(images), h, w, -1))

    def text_state(self) -> dict[str, Any]:
        return self.options.wording.state(self.package)


NEEDS_CAPTURE = False
"""The keyframes alone are enough to encode them again."""


def check(options: Options) -> model_packages.Package:
    """The model that is named. Raises ModelError if it is not there."""
    return model_packages.find_model(options.model, ("clip",), "language.clip.model")


def load(options: Options, capture: object = None) -> ClipEncoder:
    """The encoder; it needs nothing of the capture. Raises ModelError."""
    return ClipEncoder(check(options), options)


def load_text(state: dict[str, Any]) -> ModelWords:
    """The word side; the text network is looked for when a word is encoded."""
    return ModelWords(state)
