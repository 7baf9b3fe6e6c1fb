"""Options that the encoders with model packages share."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from ...settings.option_types import Cosine, Device
from ...settings.typed_options import TypedOptions
from ..text_networks import CONTRAST, TEMPLATES, Wording

ImageSide = Annotated[int, Meta(ge=16, le=4096)]
WindowSide = Annotated[int, Meta(ge=0, le=4096)]
FeatureSpacing = Annotated[int, Meta(ge=0, le=4096)]


class WordOptions(TypedOptions, frozen=True):
    """How words are encoded, and where the networks run."""

    model: str = ""
    """Folder of a model package, or its name in the models folder (see freeocc3d models list)."""
    templates: tuple[str, ...] = ()
    """Prompts for a word; {} stands for the word, and the mean of the prompts is its meaning; none = the built-in
    ones."""
    contrast: tuple[str, ...] = ()
    """What else a voxel could be: a word matches only where none of these words fits better; none = things in most
    rooms."""
    threshold: Cosine | None = None
    """Smallest cosine of a match; null = what random words reach in the map decides."""
    device: Device = "cpu"
    """Device that runs the image network: "cpu", or "cuda:0" with onnxruntime-gpu."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.wording.check()

    @property
    def wording(self) -> Wording:
        """How words become prompts, and the words that they compete with."""
        return Wording(self.templates or TEMPLATES, self.contrast or CONTRAST, self.threshold)


class PatchOptions(WordOptions, frozen=True):
    """How the patches of an image network become features of pixels."""

    short_side: ImageSide = 448
    """Frames are resized to this many pixels on the shorter side."""
    window: WindowSide | None = None
    """Edge in pixels of the windows to encode one by one; they overlap as little as covers the frame. 0 = the whole
    frame at once; null = the size of the model's training images."""
    stride: FeatureSpacing = 4
    """Pixels between features, which are upsampled from patches along the image's edges; 0 = one feature per patch."""
