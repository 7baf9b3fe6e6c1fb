"""The options that encoders with model packages share."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from ...settings.option_types import Cosine, NotNegativeInt
from ...settings.typed_options import TypedOptions
from ..text_networks import CONTRAST, TEMPLATES, Wording

ImageSide = Annotated[int, Meta(ge=16, le=4096)]
WindowSide = Annotated[int, Meta(ge=0, le=4096)]


class WordOptions(TypedOptions, frozen=True):
    """How words are asked, and where the networks run."""

    model: str = ""
    """Folder of a model package, or its name in the models folder (freeocc3d models list)."""
    templates: tuple[str, ...] = ()
    """Prompts whose mean stands for a word, which goes where they have {}; none = the built-in ones."""
    contrast: tuple[str, ...] = ()
    """Words that a voxel could be instead: a word matches only where none of them fits better; none = what most rooms
    hold."""
    threshold: Cosine = 0.15
    """Least cosine of a match."""
    device: str = "cpu"
    """Where the image network runs: "cpu", or "cuda:0" with onnxruntime-gpu."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.wording.check()

    @property
    def wording(self) -> Wording:
        """How words are asked."""
        return Wording(self.templates or TEMPLATES, self.contrast or CONTRAST, self.threshold)


class PatchOptions(WordOptions, frozen=True):
    """How the patches of an image network become features of pixels."""

    short_side: ImageSide = 336
    """Frames are resized so that their shorter side has this many pixels."""
    window: WindowSide | None = None
    """Edge in pixels of windows that are encoded one by one, half overlapping; 0 = the whole frame at once; null = the
    size of the model's training images."""
    stride: NotNegativeInt = 4
    """Pixels of the frame from one feature to the next, upsampled from patches along the image's edges; 0 = patches."""
