"""Image and text features that have CLIP's statistics, made of class images and of real text embeddings.

The words are real: CLIP's embeddings of LVIS and Objects365 names (``clip_text_names.npz``), unit vectors t = m + d
around their mean m, |m| = 0.86. Words that are not among them (walls, floors, windows, phrases that fit anything) get a
made one: the mean, and a deviation like those of related names.

A pixel's feature is, before it is normalized,

    x = A o + s_c d_c / |d_c| + a_c + v + p

    o    what all images share and no text has, the gap between modalities; its random part favors some words
    s_c  how clearly the thing shows its name: cosines to the true name are 0.22 to 0.30, to others 0.12 to 0.24
    a_c  the look of this thing, equal in all views: other names that it resembles
    v    a mistake of one view about one of its regions,  p  noise of a patch

and the features are smoothed over patches and mixed with the whole image's mean, as attention does.

Sources: the gap: V. W. Liang et al., Mind the Gap, NeurIPS 2022; the ranges of cosines are those of the issue that asks
for this measurement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from freeocc3d.language.encoders.base import Encoder, TextEncoder, TextFeatures
from freeocc3d.language.text_networks import CONTRAST

from .folders import MODELS

ANY_WORD = 0.18
"""Cosine of an image with any word; A is what is left of the unit length."""
PATCHES = 28
"""Patches along the longer side of an image."""


@dataclass(frozen=True)
class Strength:
    """signal: mean and half range over things of s_c.  look, view, patch: lengths of a_c, v and p.  blur: standard
    deviation of the smoothing, in patches.  mixed: share of the whole image's mean."""

    signal: tuple[float, float]
    look: float
    view: float
    patch: float
    blur: float
    mixed: float


STRENGTHS = {
    "easy": Strength((0.17, 0.02), 0.10, 0.14, 0.30, 0.3, 0.0),
    "middle": Strength((0.17, 0.02), 0.15, 0.20, 0.45, 0.5, 0.05),
    "hard": Strength((0.16, 0.03), 0.22, 0.30, 0.60, 0.7, 0.1),
}

RELATED = {
    "wall": ("wallpaper", "wall clock", "curtain"), "floor": ("carpet", "mat", "doormat"),
    "ceiling": ("chandelier", "fan", "lamp"), "door": ("doorknob", "shutter", "cabinet"),
    "sliding door": ("doorknob", "shutter", "curtain"),
    "window": ("curtain", "shutter", "mirror"), "shelf": ("bookcase", "cabinet", "cupboard"),
    "shelf board": ("bookcase", "cabinet", "cupboard"), "picture": ("painting", "poster", "picture frame"),
    "photo frame": ("picture frame", "painting", "poster"), "television": ("television set", "monitor"),
    "plant": ("flowerpot", "tree", "vase"), "exercise bench": ("bench", "dumbbell", "barbell"),
    "shoe rack": ("bookcase", "shoe", "cabinet"), "tv cabinet": ("cabinet", "television set", "sideboard"),
    "tableware": ("dish", "plate", "bowl"), "door handle": ("doorknob", "handle"),
}  # fmt: skip
"""Names near those that have no embedding."""
GENERIC = ("object", "objects", "thing", "things", "stuff", "texture", "background", "something")


class Words:
    """Embeddings of words: real ones where there are any."""

    def __init__(self) -> None:
        from freeocc3d.language.synonyms import make_key

        with np.load(MODELS / "clip_text_names.npz") as kept:
            self.names = [str(name) for name in kept["names"]]
            real = kept["embeddings"].astype(np.float32)
        real /= np.linalg.norm(real, axis=1, keepdims=True)
        self.mean = real.mean(axis=0)
        self._deviations = real - self.mean
        self._make_key = make_key
        self._known = {make_key(name): real[n] for n, name in reversed(list(enumerate(self.names)))}
        self.real = frozenset(self._known)

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...], length: float) -> NDArray[np.float32]:
        """Random directions that vary as names do: (…, D) of a mean square length."""
        weights = rng.standard_normal((*shape, len(self._deviations))).astype(np.float32)
        made = weights @ self._deviations
        return made * np.float32(length / np.sqrt((self._deviations**2).sum()))

    def embed(self, word: str) -> NDArray[np.float32]:
        """(D,) unit."""
        key = self._make_key(word)
        if key not in self._known:
            rng = np.random.default_rng([ord(letter) for letter in key])
            near = [self._known[k] for name in RELATED.get(word, ()) if (k := self._make_key(name)) in self._known]
            generic = word in GENERIC
            deviation = self.draw(rng, (), 0.3 if generic else 0.45 if near else 0.5)
            if near:
                deviation = 0.8 * deviation + 0.7 * (np.mean(near, axis=0) - self.mean)
            made = self.mean + deviation
            self._known[key] = made / np.linalg.norm(made)
        return self._known[key]


class SimulatedWords(TextEncoder):
    """The text part: real embeddings of names, made ones of other words."""

    threshold = None
    temperature = 0.01
    open_vocabulary = True

    def __init__(self, words: Words):
        self._words = words

    def encode_words(self, words: list[str]) -> TextFeatures:
        features = np.zeros((len(words), SimulatedClip.dimension), np.float32)
        for row, word in enumerate(words):
            features[row] = self._words.embed(word)
        return TextFeatures(features, tuple(words))

    def contrast_words(self) -> list[str]:
        return list(CONTRAST)


class SimulatedClip(Encoder):
    """An encoder: the class images of a capture as CLIP would see them. seed: of everything random."""

    name: ClassVar[str] = "simulated_clip"
    dimension = 512

    def __init__(self, words: Words, classes: Sequence[str], images: Any, strength: Strength, seed: int = 0):
        self.images, self.strength, self.seed = images, strength, seed
        self.words = words
        rng = np.random.default_rng(seed)
        apart = rng.standard_normal(self.dimension).astype(np.float32)
        toward = words.mean / np.linalg.norm(words.mean)
        apart -= (apart @ toward) * toward
        middle, half = strength.signal
        length = np.sqrt(1 - middle**2 - strength.look**2 - strength.view**2 - strength.patch**2)
        along = ANY_WORD / np.linalg.norm(words.mean)
        offset = along * toward + np.sqrt(length**2 - along**2) * apart / np.linalg.norm(apart)
        own = np.stack([words.embed(name) for name in classes]) - words.mean
        own /= np.linalg.norm(own, axis=1, keepdims=True)
        clear = rng.uniform(middle - half, middle + half, (len(classes), 1)).astype(np.float32)
        self._seen = offset + clear * own + words.draw(rng, (len(classes),), strength.look)
        self._seen[0] = offset  # a place that shows nothing

    def encode(self, frame: Any) -> NDArray[np.float16]:
        """(h, w, D) of patches."""
        from scipy import ndimage

        labels = self.images(frame.index)
        if labels is None:
            return np.zeros((1, 1, self.dimension), np.float16)
        rng = np.random.default_rng((self.seed, frame.index))
        mistakes = self.words.draw(rng, (len(self._seen),), self.strength.view)
        side = max(labels.shape) / PATCHES
        rows, columns = round(labels.shape[0] / side), round(labels.shape[1] / side)
        y = (np.arange(labels.shape[0]) * rows // labels.shape[0])[:, None]
        x = (np.arange(labels.shape[1]) * columns // labels.shape[1])[None]
        share = np.zeros((rows * columns, len(self._seen)), np.float32)
        np.add.at(share, ((y * columns + x).ravel(), labels.ravel().astype(np.int64)), 1)
        share /= share.sum(axis=1, keepdims=True)
        share = ndimage.gaussian_filter(share.reshape(rows, columns, -1), (self.strength.blur, self.strength.blur, 0))
        share = (1 - self.strength.mixed) * share + self.strength.mixed * share.mean(axis=(0, 1))
        out = share @ (self._seen + mistakes)
        noise = rng.standard_normal(out.shape).astype(np.float32)
        out += noise * np.float32(self.strength.patch / np.sqrt(self.dimension))
        return (out / np.linalg.norm(out, axis=-1, keepdims=True)).astype(np.float16)

    def text_state(self) -> dict[str, Any]:
        return {}
