"""Any CLIP or SigLIP ViT as a model package: dense features by a changed last attention; understands any words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ...core.errors import ModelError
from ...core.types import Frame
from ...settings.option_types import Advanced
from .. import model_packages
from ..text_networks import ModelWords
from .base import WELL_COVERED, Encoder
from .model_options import PatchOptions

if TYPE_CHECKING:
    from ..patch_features import Tiling

REQUIRES: tuple[str, ...] = ("onnxruntime", "tokenizers")

Attention = Literal["plain", "maskclip", "sclip", "clearclip", "naclip"]


class Options(PatchOptions, frozen=True):
    """The model, and how its patches become features of pixels."""

    model: str = ""
    """Folder of a model package of kind "clip" or "windows", or its name in the models folder (see freeocc3d models
    list)."""
    attention: Advanced[Attention] = "naclip"
    """Attention of the last block; "naclip" has the best results in the papers."""


class ClipEncoder(Encoder):
    """Patch features in the space of words, joined from windows and upsampled along the image's edges."""

    name: ClassVar[str] = "clip"
    coverage = WELL_COVERED

    def __init__(self, package: model_packages.Package, options: Options):
        self.package = package
        self.options = options
        self.dimension = package.dimension
        self._image = package.session("image", options.device)
        if package.kind == "clip":
            self._head = package.session("head", options.device)

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(ceil(H / stride), ceil(W / stride), D) float16; (rows, columns, D) of patches if stride is 0."""
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
        h, w = tiling.window
        q, k, v, stream = self._attention_of(images, h * w)
        mixed = clip_attention.mix_values(chosen, q, k, v, tiling.window)
        output = "features" if clip_attention.KEEPS_REST[chosen] else "reduced"
        shapes = {output: (*stream.shape[:2], self.dimension)}
        (features,) = self._head.run([output], {"mixed": mixed, "stream": stream}, shapes)
        return np.asarray(features[:, -h * w :].reshape(len(images), h, w, -1))

    def pooled(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, D) the network's own embeddings of (B, 3, H, W) normalized images; H and W are multiples of the patch. A
        test compares a package with its checkpoint by them."""
        from .. import clip_attention

        grid = images.shape[2] // self.package.patch, images.shape[3] // self.package.patch
        q, k, v, stream = self._attention_of(images, grid[0] * grid[1])
        mixed = clip_attention.mix_values("plain", q, k, v, grid)
        return np.asarray(self._head.run(["pooled"], {"mixed": mixed, "stream": stream})[0])

    def embed(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The network's own embedding of a picture, which is resized to the size of the training images."""
        from ..patch_features import normalize_patches, resize_image

        size = self.package.input_size, self.package.input_size
        image = resize_image(rgb, size, self.package.mean, self.package.std)
        return normalize_patches(self.pooled(image[None]))[0]

    def _attention_of(self, images: NDArray[np.float32], patches: int) -> list[NDArray[np.float32]]:
        """Queries, keys and values (B, heads, N, d) of the last block, and its stream (B, N, heads d). Raises
        ModelError."""
        names = ["queries", "keys", "values", "stream"]
        parts = self._image.run(names, {"image": images}, dict.fromkeys(names[:3], (len(images), None, None, None)))
        tokens = patches + self.package.prefix_tokens
        batch, heads, _, width = parts[0].shape
        own = [(batch, heads, tokens, width)] * 3 + [(batch, tokens, heads * width)]
        if [part.shape for part in parts] != own:
            raise ModelError(
                f"{self._image.path} gives attention of {parts[0].shape[2]} tokens for images of {patches} patches and "
                f"{self.package.prefix_tokens} other tokens, or its parts do not fit each other: export it again."
            )
        return parts

    def text_state(self) -> dict[str, Any]:
        return self.options.wording.state(self.package)


class WindowsEncoder(ClipEncoder):
    """The embeddings of whole windows, for a network that could not be cut before its last attention. All patches of a
    window get its embedding, and those of overlapping windows their mean."""

    def patches(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(rows, columns, D) unit features of the patches of (H, W, 3) pixels."""
        from ..patch_features import encode_windows

        side = self.package.input_size
        short_side = max(self.options.short_side, side)
        return encode_windows(rgb, self.package, short_side, side, self._window_features, half_overlap=True)

    def _window_features(self, images: NDArray[np.float32], tiling: Tiling) -> NDArray[np.float32]:
        shape = len(images), *tiling.window, self.dimension
        return np.broadcast_to(self.pooled(images)[:, None, None], shape)

    def pooled(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, D) embeddings of (B, 3, H, W) normalized images, both of the size of the training images."""
        (pooled,) = self._image.run(["pooled"], {"image": images}, {"pooled": (len(images), self.dimension)})
        return pooled


NEEDS_CAPTURE = False
"""Encoding keyframes again needs only the keyframes."""


def check(options: Options) -> model_packages.Package:
    """Finds the model that the options name. Raises ModelError if it does not exist."""
    return model_packages.find_model(options.model, ("clip", "windows"), "language.clip.model")


def load(options: Options, capture: object = None) -> ClipEncoder:
    """Makes the encoder; it needs nothing from the capture. Raises ModelError."""
    package = check(options)
    return (ClipEncoder if package.kind == "clip" else WindowsEncoder)(package, options)


def load_text(state: dict[str, Any]) -> ModelWords:
    """Restores the text part; it looks for the text network when it first encodes a word."""
    return ModelWords(state)
