"""The contract of an encoder: images to dense features, words to unit features in the same space.

An encoder is one file of this folder with ``load(options, capture) -> Encoder`` for building a map, and
``load_text(state) -> TextEncoder`` for asking one; one that asks nothing of the capture says ``NEEDS_CAPTURE = False``;
one that needs files of its own, such as networks, has ``check(options)``, which raises ModelError where they are not.
The second half must import fast (numpy only where it can): it runs in ``tools/query.py``, where neither the capture nor
the images are at hand.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...core.types import Frame


@dataclass(frozen=True)
class TextFeatures:
    """Words in the encoder's space.

    features: (W, D) float32 unit rows; a zero row for a word that the encoder cannot express at all.
    understood: for each word the part that was used ("white" of "white sofa"), empty if none was.
    attainable: (W,) float32 in 0…1, the cosine that a thing which fits the word perfectly reaches; None stands for 1.
        It is less for a word that covers several kinds: of "table" over coffee, dining and side tables, each an axis of
        its own, a coffee table reaches 1/√3. A query divides by it, so that general and special words compare.
    """

    features: NDArray[np.float32]
    understood: tuple[str, ...]
    attainable: NDArray[np.float32] | None = None


class TextEncoder(ABC):
    """The word side of an encoder, restored from what the map saved."""

    threshold: float
    """Score (cosine over the attainable cosine) from which a voxel matches a word that beats the contrast words."""
    temperature: float
    """Softmax temperature that turns scores into a confidence against the contrast words."""
    same_word: float = 0.9
    """A contrast word whose text feature has at least this cosine to the asked word's says the same, or a part of it:
    it does not compete."""
    open_vocabulary: bool = False
    """Whether any word has a meaning of its own: what a model names in a scene then competes with what is asked for,
    and pictures by class show it."""
    knows: str = "words like those that it was trained on"
    """What can be asked, in words, for the note about a word that is not understood."""

    @abstractmethod
    def encode_words(self, words: list[str]) -> TextFeatures:
        """Words or phrases, any case, to unit features."""

    @abstractmethod
    def contrast_words(self) -> list[str]:
        """What a voxel could be instead: a word matches only where it scores at least as high as each of these (but
        for those that say the same, see ``same_word``)."""


class Encoder(ABC):
    """The image side of an encoder."""

    name: ClassVar[str]
    dimension: int
    """D, the length of a feature."""

    @abstractmethod
    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(h, w, D) float16 features that cover the frame's image evenly (h, w may be smaller than H, W). Of each the
        direction is what the encoder says, and the length how sure of it the encoder is: 1 for one that does not say,
        0 where it has nothing to say. It is the weight of that feature when views are fused."""

    @abstractmethod
    def text_state(self) -> dict[str, Any]:
        """What ``load_text`` needs to restore the word side: numbers, strings, lists and dicts only (it is saved as
        YAML in the map's manifest)."""
