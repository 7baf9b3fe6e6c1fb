"""The contract of an encoder: it turns images into dense features, and words into unit features in the same space.

An encoder is one file of this folder with ``load(options, capture) -> Encoder`` to build a map, and ``load_text(state)
-> TextEncoder`` to query it. An encoder that needs nothing from the capture sets ``NEEDS_CAPTURE = False``. An encoder
that needs files of its own, such as networks, has ``check(options)``, which raises ModelError if they are missing.

The text part must import fast (numpy only where possible): ``tools/query.py`` runs it without the capture or the
images.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...core.types import Frame

WELL_COVERED = 0.97
"""Coverage for encoders whose time is a network's. A third of the keyframes shows as much in both houses, and loses at
most 2 points of mIoU with class images averaged over patches; the time saved buys finer patches, which gain 2 to 8."""


@dataclass(frozen=True)
class TextFeatures:
    """Words in the encoder's space.

    features: (W, D) float32 unit rows; zero for a word that the encoder cannot express.
    understood: the part of each word that was used ("white" of "white sofa"); empty if no part was.
    attainable: (W,) float32 in 0…1, the cosine of a thing that fits the word perfectly; None means 1. It is less than 1
        for a word that covers several kinds. If "table" covers coffee, dining and side tables, each an axis of its own,
        a coffee table reaches 1/√3. A query divides by it, so that general and specific words are comparable.
    meant: the names of classes that each word was taken for; () where the encoder has no classes.
    """

    features: NDArray[np.float32]
    understood: tuple[str, ...]
    attainable: NDArray[np.float32] | None = None
    meant: tuple[tuple[str, ...], ...] = ()


class TextEncoder(ABC):
    """The text part of an encoder, restored from the state that the map saved."""

    threshold: float | None
    """A voxel matches a word that beats the contrast words if its score (cosine / attainable cosine) is at least this.
    None = what random words reach in the map decides (``query.chance``), for an encoder of any words."""
    temperature: float
    """Softmax temperature that turns scores into a confidence relative to the contrast words."""
    same_word: float = 0.9
    """A contrast word does not compete if its text feature has at least this cosine to that of the query word: it means
    the same, or a part of it."""
    open_vocabulary: bool = False
    """Whether every word has its own meaning. If so, the names that a model found in the scene compete with the query,
    and pictures by class use them."""
    knows: str = "words like those that it was trained on"
    """Describes the possible queries, for the note about a word that is not understood."""

    @abstractmethod
    def encode_words(self, words: list[str]) -> TextFeatures:
        """Unit features of words or phrases, in upper or lower case."""

    @abstractmethod
    def contrast_words(self) -> list[str]:
        """What else a voxel could be. A word matches only where its score is at least that of each of these words,
        except those that mean the same (see ``same_word``)."""


class Encoder(ABC):
    """The image part of an encoder."""

    name: ClassVar[str]
    dimension: int
    """D, the length of a feature."""
    coverage: ClassVar[float | None] = None
    """Share of the surface that the encoded keyframes show, of what all keyframes show; None = encode all of them. See
    ``WELL_COVERED``."""

    @abstractmethod
    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(h, w, D) float16 features that cover the frame's image evenly (h, w may be smaller than H, W). The direction
        of a feature is its meaning. Its length is the encoder's confidence, and its weight when views are fused: 1 for
        an encoder that gives no confidence, 0 where the encoder has no result."""

    def embed(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32] | None:
        """(D,) unit embedding of a whole picture, (H, W, 3), in the space of words; None if the encoder has no such
        embedding. Networks that were trained on whole pictures understand a thing that fills one best."""
        return None

    @abstractmethod
    def text_state(self) -> dict[str, Any]:
        """The state that ``load_text`` needs to restore the text part: numbers, strings, lists and dicts only (the
        map's manifest saves it as YAML)."""
