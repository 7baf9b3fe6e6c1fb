"""Patches in the space of words as a model package: DINO aligned with text, RADIO, convolutional CLIPs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...core.types import Frame
from .. import model_packages
from ..text_networks import ModelWords
from .base import WELL_COVERED, Encoder
from .model_options import PatchOptions, WindowSide

if TYPE_CHECKING:
    from ..patch_features import Tiling

REQUIRES: tuple[str, ...] = ("onnxruntime", "tokenizers")


class Options(PatchOptions, frozen=True):
    """The model, and how its patches become features of pixels."""

    model: str = ""
    """Folder of a model package of kind "dense", or its name in the models folder (see freeocc3d models list)."""
    window: WindowSide | None = 0


class Dinov2Encoder(Encoder):
    """Patch features that are already in the space of words, joined from windows and upsampled."""

    name: ClassVar[str] = "dinov2"
    coverage = WELL_COVERED

    def __init__(self, package: model_packages.Package, options: Options):
        self.package = package
        self.options = options
        self.dimension = package.dimension
        self._image = package.session("image", options.device)

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(ceil(H / stride), ceil(W / stride), D) float16; (rows, columns, D) of patches if stride is 0."""
        from ..patch_features import encode_windows, finish_patches

        options, rgb = self.options, frame.color
        short_side, window = options.short_side, options.window
        if isinstance(self._image.inputs["image"][-1], int):  # it takes images of one size alone
            short_side, window = max(short_side, self.package.input_size), None
        patches = encode_windows(rgb, self.package, short_side, window, self._window_features)
        return finish_patches(patches, rgb, options.stride)

    def _window_features(self, images: NDArray[np.float32], tiling: Tiling) -> NDArray[np.float32]:
        """(B, h, w, D) of (B, 3, H, W) windows."""
        shapes = {"features": (len(images), *tiling.window, self.dimension)}
        return np.asarray(self._image.run(["features"], {"image": images}, shapes)[0])

    def text_state(self) -> dict[str, Any]:
        return self.options.wording.state(self.package)


NEEDS_CAPTURE = False
"""Encoding keyframes again needs only the keyframes."""


def check(options: Options) -> model_packages.Package:
    """Finds the model that the options name. Raises ModelError if it does not exist."""
    return model_packages.find_model(options.model, ("dense",), "language.dinov2.model")


def load(options: Options, capture: object = None) -> Dinov2Encoder:
    """Makes the encoder; it needs nothing from the capture. Raises ModelError."""
    return Dinov2Encoder(check(options), options)


def load_text(state: dict[str, Any]) -> ModelWords:
    """Restores the text part; it looks for the text network when it first encodes a word."""
    return ModelWords(state)
