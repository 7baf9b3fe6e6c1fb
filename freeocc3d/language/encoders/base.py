"""The contract of an encoder: images to dense unit features, words to unit features in the same space.

An encoder is one file of this folder with ``load(options, capture) -> Encoder`` for building a map, and
``load_text(state) -> TextEncoder`` for asking one. The second half must import fast (numpy only where it can): it runs
in ``tools/query.py``, where neither the capture nor the images are at hand.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...types import Frame


@dataclass(frozen=True)
class TextFeatures:
    """Words in the encoder's space.

    features: (W, D) float32 unit rows; a zero row for a word that the encoder cannot express at all.
    understood: for each word the part that was used ("white" of "white sofa"), empty if none was.
    """

    features: NDArray[np.float32]
    understood: tuple[str, ...]


class TextEncoder(ABC):
    """The word side of an encoder, restored from what the map saved."""

    threshold: float
    """Cosine similarity from which a voxel matches a word, for words that beat the contrast words there."""
    temperature: float
    """Softmax temperature that turns similarities into a confidence against the contrast words."""

    @abstractmethod
    def encode_words(self, words: list[str]) -> TextFeatures:
        """Words or phrases, any case, to unit features."""

    @abstractmethod
    def contrast_words(self) -> list[str]:
        """What a voxel could be instead: a word matches only where it scores above these (and is none of them)."""


class Encoder(ABC):
    """The image side of an encoder."""

    name: ClassVar[str]
    dimension: int
    """D, the length of a feature."""

    @abstractmethod
    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(h, w, D) float16 features that cover the frame's image evenly (h, w may be smaller than H, W); each is of
        unit length, or zero where the encoder has nothing to say."""

    @abstractmethod
    def text_state(self) -> dict[str, Any]:
        """What ``load_text`` needs to restore the word side: numbers, strings, lists and dicts only (it is saved as
        YAML in the map's manifest)."""
