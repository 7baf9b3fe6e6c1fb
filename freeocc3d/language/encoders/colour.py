"""Colour names, no network: a small perceptual space in which "red", "dark blue" and "white sofa" have a meaning."""

from __future__ import annotations

import re
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...capture.base import Capture
from ...types import Frame
from .base import Encoder, TextEncoder, TextFeatures

REQUIRES: tuple[str, ...] = ()

PROTOTYPES: tuple[tuple[str, str], ...] = (
    ("black", "101010"), ("black", "282828"), ("grey", "484848"), ("grey", "707070"), ("grey", "989898"),
    ("white", "c8c8c8"), ("white", "e0e0e0"), ("white", "fcfcfc"),
    ("red", "5e1014"), ("red", "a01820"), ("red", "e02028"), ("red", "d8504c"),
    ("orange", "c85a10"), ("orange", "f08020"), ("orange", "f6a050"),
    ("yellow", "b09418"), ("yellow", "f0d020"), ("yellow", "f4e480"),
    ("green", "184020"), ("green", "287838"), ("green", "30b048"), ("green", "98d890"), ("green", "6c7c28"),
    ("turquoise", "106868"), ("turquoise", "28b0b0"), ("turquoise", "90dcd8"),
    ("blue", "101c50"), ("blue", "1c3c94"), ("blue", "2868d8"), ("blue", "88b8ec"),
    ("purple", "40185c"), ("purple", "7030a0"), ("purple", "b090d8"),
    ("pink", "d83c88"), ("pink", "f080b0"), ("pink", "f4b8c8"),
    ("brown", "382010"), ("brown", "6c4020"), ("brown", "986840"),
    ("beige", "c0a078"), ("beige", "e0cca8"),
)  # fmt: skip
"""Colour term -> sRGB examples of it, dark to light. The eleven basic terms of B. Berlin and P. Kay (Basic Color Terms,
1969) and two more that people say of rooms; the examples are our own choice."""

TERMS = tuple(dict.fromkeys(term for term, _ in PROTOTYPES))
TONES = ("dark", "medium", "light")

_TERM_SHARE = 0.6
"""Part of a feature's squared length that tells the term; the rest tells the tone."""
_LIGHTNESS_WEIGHT = 0.6  # shadows change lightness more than they change hue
_SPREAD = 11.0  # of a term around its examples, in CIELAB units
_LUT_BITS = 5
_BLOCK = 4

_OTHER_NAMES: dict[str, tuple[str, ...]] = {
    "gray": ("grey",), "silver": ("light", "grey"), "charcoal": ("dark", "grey"), "anthracite": ("dark", "grey"),
    "crimson": ("red",), "scarlet": ("red",), "maroon": ("dark", "red"), "burgundy": ("dark", "red"),
    "gold": ("yellow",), "golden": ("yellow",), "lemon": ("yellow",), "amber": ("orange",), "lime": ("light", "green"),
    "olive": ("dark", "green"), "mint": ("light", "green"), "teal": ("dark", "turquoise"), "cyan": ("turquoise",),
    "aqua": ("turquoise",), "navy": ("dark", "blue"), "azure": ("light", "blue"), "violet": ("purple",),
    "lilac": ("light", "purple"), "lavender": ("light", "purple"), "magenta": ("pink",), "rose": ("pink",),
    "chocolate": ("dark", "brown"), "tan": ("beige",), "cream": ("beige",), "ivory": ("beige",), "sand": ("beige",),
}  # fmt: skip
_TONE_WORDS = {"dark": "dark", "deep": "dark", "medium": "medium", "light": "light", "pale": "light", "bright": "light"}


class ColourEncoder(Encoder):
    """f = (sqrt(0.6 m), sqrt(0.4 l)) with m a pixel's memberships in the terms and l in the tones, each summing to one:
    f is of unit length, and the cosine of two features a mean of two Bhattacharyya coefficients."""

    name: ClassVar[str] = "colour"
    dimension = len(TERMS) + len(TONES)

    def __init__(self) -> None:
        steps = (np.arange(1 << _LUT_BITS) + 0.5) * (256 >> _LUT_BITS)
        rgb = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        self._memberships = memberships(rgb)

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        shift = 8 - _LUT_BITS
        rgb = frame.color[::2, ::2].astype(np.int32) >> shift
        entry = (rgb[..., 0] << 2 * _LUT_BITS) | (rgb[..., 1] << _LUT_BITS) | rgb[..., 2]
        half = _BLOCK // 2
        height, width = (max(1, size // half) for size in entry.shape)
        entry = entry[: height * half, : width * half]
        m = self._memberships[entry]
        m = m.reshape(height, entry.shape[0] // height, width, entry.shape[1] // width, -1).mean(axis=(1, 3))
        return np.sqrt(m).astype(np.float16)

    def text_state(self) -> dict[str, Any]:
        return {"terms": list(TERMS)}


class ColourWords(TextEncoder):
    """Colour words, with tones, in any phrase; the rest of the phrase is not understood."""

    threshold = 0.7
    temperature = 0.1

    def encode_words(self, words: list[str]) -> TextFeatures:
        parsed = [parse(word) for word in words]
        features = np.zeros((len(words), len(TERMS) + len(TONES)), np.float32)
        for row, (terms, tone) in enumerate(parsed):
            for term in terms:
                features[row, TERMS.index(term)] = np.sqrt(_TERM_SHARE / len(terms))
            if terms:
                among = [tone] if tone else list(TONES)
                for name in among:
                    features[row, len(TERMS) + TONES.index(name)] = np.sqrt((1 - _TERM_SHARE) / len(among))
        return TextFeatures(features, tuple(" ".join([*([tone] if tone else []), *terms]) for terms, tone in parsed))

    def contrast_words(self) -> list[str]:
        return list(TERMS)


def load(capture: Capture) -> ColourEncoder:
    """The encoder; it needs nothing of the capture."""
    return ColourEncoder()


def load_text(state: dict[str, Any]) -> ColourWords:
    """The word side."""
    return ColourWords()


def parse(phrase: str) -> tuple[list[str], str | None]:
    """The colour terms of a phrase, and the tone that they are qualified with."""
    terms: list[str] = []
    tone = None
    for token in re.findall(r"[a-z]+", phrase.lower()):
        for part in _meaning(token):
            if part in TONES:
                tone = part
            elif part not in terms:
                terms.append(part)
    return terms, tone if terms else None


def _meaning(token: str) -> tuple[str, ...]:
    """Terms and tones that one word stands for: itself, another name, or with -ish, -coloured or -s taken off."""
    stems = [token, *(token.removesuffix(end) for end in ("s", "ish", "dish", "tish") if token.endswith(end))]
    for stem in (*stems, *(f"{stem}e" for stem in stems[1:])):
        if stem in TERMS:
            return (stem,)
        if stem in _OTHER_NAMES:
            return _OTHER_NAMES[stem]
        if stem in _TONE_WORDS:
            return (_TONE_WORDS[stem],)
    return ()


def memberships(rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """(N, 3) sRGB 0…255 to (N, terms + tones): memberships times their share, rows sum to one."""
    lab = rgb_to_lab(rgb)
    examples = rgb_to_lab(np.array([[int(code[i : i + 2], 16) for i in (0, 2, 4)] for _, code in PROTOTYPES], float))
    weight = np.array((_LIGHTNESS_WEIGHT, 1.0, 1.0))
    squared = (((lab[:, None] - examples[None]) * weight) ** 2).sum(axis=2)
    closeness = np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True)) / _SPREAD**2)
    terms = np.zeros((len(rgb), len(TERMS)))
    for column, (term, _) in enumerate(PROTOTYPES):
        index = TERMS.index(term)
        terms[:, index] = np.maximum(terms[:, index], closeness[:, column])
    terms /= terms.sum(axis=1, keepdims=True)
    dark = 1.0 / (1.0 + np.exp((lab[:, 0] - 38.0) / 4.0))
    light = 1.0 / (1.0 + np.exp((68.0 - lab[:, 0]) / 4.0))
    tones = np.stack((dark, 1.0 - dark - light, light), axis=1).clip(0.0)
    tones /= tones.sum(axis=1, keepdims=True)
    return np.concatenate((_TERM_SHARE * terms, (1 - _TERM_SHARE) * tones), axis=1).astype(np.float32)


def rgb_to_lab(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """(N, 3) sRGB 0…255 to CIELAB under D65 (IEC 61966-2-1, CIE 15)."""
    c = np.asarray(rgb, np.float64) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array(
        ((0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041))
    )
    xyz = linear @ to_xyz.T / (0.95047, 1.0, 1.08883)
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.stack((116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])), axis=1)
