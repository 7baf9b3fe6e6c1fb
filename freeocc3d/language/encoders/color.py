"""Color names, without a network: "red", "dark blue" and "white sofa" (as white) have a meaning.

A pixel belongs partly to several named colors. Its membership in color c is m_c = exp(-d_c^2 / 2 sigma^2), normalized
to sum 1. d_c is the CIE94 difference to the nearest of c's centroids; lightness has half weight because shading changes
it within an object. Colors are grouped into basic terms ("dark blue" is blue), mu = M m, and the feature is

    f = (sqrt(mu / 2), sqrt(m / 2)),   of unit length because mu and m each sum to 1.

The text feature of a term is its axis in the first half. The text feature of another name, with the distribution q over
the colors, is (sqrt(M q / 5), sqrt(4 q / 5)), so that "dark blue" is somewhat similar to every blue. Each half of a
cosine is a Bhattacharyya coefficient.

Source: the names are the eleven basic terms of B. Berlin and P. Kay (Basic Color Terms, 1969) with light and dark
variants, and a few more that people use for rooms. The centroids are our own choice in CIELAB. Nothing is trained.
CIE94: CIE publication 116-1995.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...core.errors import MapError
from ...core.types import Frame
from ...settings.option_types import Stride
from ...settings.typed_options import TypedOptions
from .base import Encoder, TextEncoder, TextFeatures

if TYPE_CHECKING:
    from ...capture.base import Capture

REQUIRES: tuple[str, ...] = ()

CENTROIDS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "white": ((100, 0, 0), (80, 2, 80), (84, 9, 82), (80, 4, 220)),
    "light grey": ((64, 1, 0), (64, 6, 85), (64, 5, 230)),
    "grey": ((50, 1, 0), (50, 5, 80), (50, 5, 240)),
    "dark grey": ((34, 1, 0), (34, 4, 70), (34, 7, 260)),
    "black": ((6, 1, 0), (14, 3, 60), (14, 4, 270), (2, 6, 50)),
    "red": ((53, 100, 40), (46, 78, 36), (38, 60, 32), (32, 50, 29), (55, 60, 32)),
    "dark red": ((24, 42, 28), (18, 32, 26), (12, 22, 26), (30, 30, 24)),
    "pink": ((85, 22, 5), (72, 40, 0), (62, 32, 12), (66, 62, 356), (70, 45, 22)),
    "magenta": ((60, 112, 328), (48, 72, 350), (40, 60, 342), (34, 45, 350)),
    "purple": ((32, 68, 322), (30, 48, 308), (22, 34, 312), (40, 55, 314), (38, 26, 315)),
    "light purple": ((78, 24, 307), (62, 42, 310), (68, 18, 312)),
    "dark blue": ((13, 60, 304), (8, 24, 295), (20, 26, 280), (20, 40, 292), (27, 20, 268)),
    "blue": ((33, 130, 306), (40, 72, 291), (38, 46, 280), (48, 56, 280), (46, 34, 265)),
    "light blue": ((84, 16, 230), (78, 26, 238), (64, 40, 268), (72, 18, 255), (66, 26, 245)),
    "turquoise": ((90, 48, 196), (80, 44, 188), (64, 36, 198), (48, 28, 196), (32, 22, 198)),
    "light green": ((87, 60, 137), (86, 22, 138), (74, 32, 140), (90, 85, 128), (80, 16, 155)),
    "green": ((70, 95, 136), (48, 70, 137), (52, 46, 144), (42, 34, 145), (56, 36, 128)),
    "dark green": ((33, 48, 138), (22, 26, 146), (28, 18, 150), (14, 16, 145)),
    "olive": ((52, 56, 105), (42, 36, 106), (34, 26, 105), (56, 26, 108)),
    "yellow": ((96, 96, 102), (87, 86, 90), (78, 72, 92), (94, 50, 102), (66, 62, 94), (56, 58, 94)),
    "orange": ((75, 84, 72), (67, 90, 58), (62, 76, 54), (72, 66, 66)),
    "brown": ((38, 48, 58), (36, 30, 64), (46, 38, 64), (42, 24, 66)),
    "dark brown": ((22, 22, 58), (16, 12, 60), (28, 14, 65)),
    "light brown": ((62, 42, 70), (62, 30, 74), (56, 44, 62), (70, 36, 76), (54, 22, 75), (66, 26, 88), (62, 22, 95)),
    "beige": ((84, 17, 82), (78, 22, 80), (92, 16, 95), (74, 15, 82), (78, 24, 92)),
}
"""Centroids of each color as (lightness 0…100, chroma, hue in degrees) in CIELAB of sRGB under D65."""

Meaning = dict[str, float]
"""Shares of the colors of CENTROIDS, up to a common factor."""

TERMS: dict[str, Meaning] = {
    "white": {"white": 1.0, "light grey": 0.2},
    "grey": {"light grey": 0.8, "grey": 1.0, "dark grey": 0.9},
    "black": {"black": 1.0, "dark grey": 0.1},
    "red": {"red": 1.0, "dark red": 1.0},
    "orange": {"orange": 1.0},
    "yellow": {"yellow": 1.0},
    "green": {"green": 1.0, "light green": 1.0, "dark green": 1.0, "olive": 0.8},
    "turquoise": {"turquoise": 1.0},
    "blue": {"blue": 1.0, "light blue": 1.0, "dark blue": 1.0},
    "purple": {"purple": 1.0, "light purple": 1.0, "magenta": 0.2},
    "pink": {"pink": 1.0, "magenta": 0.8},
    "brown": {"brown": 1.0, "light brown": 0.9, "dark brown": 1.0, "olive": 0.2},
    "beige": {"beige": 1.0, "light brown": 0.1},
}
"""Basic terms, and the share of each color in them: the matrix M."""

_GOLD = {"yellow": 0.6, "light brown": 0.4}

NAMES: dict[str, Meaning] = {
    "aqua": {"turquoise": 0.8, "light blue": 0.2},
    "anthracite": {"dark grey": 0.7, "black": 0.3},
    "azure": {"light blue": 0.6, "blue": 0.4},
    "burgundy": {"dark red": 1.0},
    "charcoal": {"dark grey": 0.7, "black": 0.3},
    "coral": {"pink": 0.5, "orange": 0.25, "red": 0.25},
    "cream": {"beige": 0.6, "white": 0.4},
    "crimson": {"red": 0.6, "dark red": 0.4},
    "cyan": {"turquoise": 0.8, "light blue": 0.2},
    "fuchsia": {"magenta": 1.0},
    "gold": _GOLD,
    "golden": _GOLD,
    "indigo": {"dark blue": 0.5, "purple": 0.5},
    "ivory": {"white": 0.6, "beige": 0.4},
    "khaki": {"olive": 0.5, "light brown": 0.5},
    "lavender": {"light purple": 1.0},
    "lilac": {"light purple": 1.0},
    "lime": {"light green": 0.7, "yellow": 0.3},
    "magenta": {"magenta": 0.8, "pink": 0.2},
    "maroon": {"dark red": 0.8, "dark brown": 0.2},
    "mauve": {"light purple": 0.7, "pink": 0.3},
    "mint": {"light green": 0.7, "turquoise": 0.3},
    "navy": {"dark blue": 1.0},
    "olive": {"olive": 1.0},
    "salmon": {"pink": 0.8, "orange": 0.2},
    "scarlet": {"red": 1.0},
    "silver": {"light grey": 0.7, "grey": 0.3},
    "tan": {"light brown": 0.8, "beige": 0.2},
    "teal": {"turquoise": 0.8, "dark green": 0.2},
    "violet": {"purple": 0.8, "light purple": 0.2},
}
"""The meaning of other color names."""

_DARK: dict[str, Meaning] = {
    "red": {"dark red": 0.9, "red": 0.1},
    "orange": {"orange": 0.6, "brown": 0.4},
    "yellow": {"olive": 0.5, "yellow": 0.5},
    "green": {"dark green": 0.9, "green": 0.1},
    "blue": {"dark blue": 0.9, "blue": 0.1},
    "purple": {"purple": 1.0},
    "pink": {"magenta": 0.7, "pink": 0.3},
    "brown": {"dark brown": 0.9, "brown": 0.1},
    "white": {"light grey": 1.0},
    "grey": {"dark grey": 0.9, "grey": 0.1},
    "beige": {"light brown": 0.7, "beige": 0.3},
    "turquoise": {"turquoise": 0.8, "dark green": 0.2},
}
_LIGHT: dict[str, Meaning] = {
    "red": {"red": 0.5, "pink": 0.5},
    "orange": {"orange": 0.7, "beige": 0.3},
    "yellow": {"yellow": 0.7, "beige": 0.3},
    "green": {"light green": 0.9, "green": 0.1},
    "blue": {"light blue": 0.9, "blue": 0.1},
    "purple": {"light purple": 0.9, "purple": 0.1},
    "pink": {"pink": 1.0},
    "brown": {"light brown": 0.8, "beige": 0.2},
    "black": {"dark grey": 1.0},
    "grey": {"light grey": 0.9, "grey": 0.1},
    "turquoise": {"turquoise": 0.8, "light blue": 0.2},
}
_BRIGHT: dict[str, Meaning] = {
    "red": {"red": 1.0},
    "green": {"green": 0.6, "light green": 0.4},
    "blue": {"blue": 0.9, "light blue": 0.1},
    "purple": {"purple": 1.0},
    "pink": {"pink": 0.6, "magenta": 0.4},
    "white": {"white": 1.0},
}
MODIFIERS = {"dark": _DARK, "deep": _DARK, "light": _LIGHT, "pale": _LIGHT, "bright": _BRIGHT, "vivid": _BRIGHT}
"""The meaning of a color name after a modifier; a name that is not listed keeps its own meaning."""

_SPELLINGS = {"gray": "grey"}

_SIGMA = 3.5  # of a membership, in CIE94 units
_LIGHTNESS_WEIGHT = 0.5
_TERM_SHARE = 0.2  # of the squared text feature of a shade, for its basic term
_TABLE_BITS = 5  # resolution of the look-up table per channel


Channel = Annotated[float, Meta(ge=16, le=255)]


class Options(TypedOptions, frozen=True):
    """How pixels get color names."""

    stride: Stride = 4
    """Edge in pixels of the blocks over which memberships are averaged into one feature."""
    white: tuple[Channel, Channel, Channel] | None = None
    """RGB (16 to 255) of a white thing in this capture, for scans in colored or dim light; null = colors are not
    corrected."""


class ColorEncoder(Encoder):
    """sqrt of the mean color memberships of blocks of pixels."""

    name: ClassVar[str] = "color"
    dimension = len(TERMS) + len(CENTROIDS)

    def __init__(self, options: Options | None = None):
        self.options = options or Options()
        self._bins = _channel_bins(self.options.white)
        self._table = _table()

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(ceil(H / stride), ceil(W / stride), D) float16."""
        import cv2
        import torch

        rgb, stride = frame.color, self.options.stride
        height, width = -(-rgb.shape[0] // stride), -(-rgb.shape[1] // stride)
        bottom, right = height * stride - rgb.shape[0], width * stride - rgb.shape[1]
        if bottom or right:
            rgb = cv2.copyMakeBorder(rgb, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
        samples = max(1, stride // 2)  # per side: averaging pixels in pairs first reduces noise and work
        rgb = cv2.resize(rgb, (width * samples, height * samples), interpolation=cv2.INTER_AREA)
        entry = self._bins[0][rgb[..., 0]] + self._bins[1][rgb[..., 1]] + self._bins[2][rgb[..., 2]]
        total = np.zeros((height, width, self.dimension), np.float32)
        for row in range(samples):
            for column in range(samples):
                total += self._table[entry[row::samples, column::samples]]
        total *= np.float32(1 / samples**2)
        halves = torch.from_numpy(np.sqrt(total, out=total)).to(torch.float16)  # NumPy takes 30 times as long
        return np.asarray(halves.numpy(), np.float16)

    def text_state(self) -> dict[str, Any]:
        return {"terms": list(TERMS), "colors": list(CENTROIDS)}


class ColorWords(TextEncoder):
    """Color names, with modifiers, in any phrase; other words of the phrase are ignored."""

    threshold = 0.6
    temperature = 0.1
    same_word = 0.3
    knows = "color names (its encoder uses no network)"

    def __init__(self) -> None:
        self._pure = np.sqrt(features_squared(np.eye(len(CENTROIDS))))

    def encode_words(self, words: list[str]) -> TextFeatures:
        features = np.zeros((len(words), len(TERMS) + len(CENTROIDS)), np.float32)
        attainable = np.ones(len(words), np.float32)
        understood = []
        for row, word in enumerate(words):
            meanings = parse_colors(word)
            understood.append(", ".join(meanings))
            if meanings:
                features[row] = np.sqrt(np.mean([_text_squared(m) for m in meanings.values()], axis=0))
                attainable[row] = (self._pure @ features[row]).max()  # reached by a thing of a single color
        return TextFeatures(features, tuple(understood), attainable)

    def contrast_words(self) -> list[str]:
        return list(TERMS)


NEEDS_CAPTURE = False
"""Whether ``load`` needs the capture; encoding keyframes again needs only the keyframes."""


def load(options: Options, capture: Capture | None) -> ColorEncoder:
    """Makes the encoder; it needs nothing from the capture."""
    return ColorEncoder(options)


def load_text(state: dict[str, Any]) -> ColorWords:
    """Restores the text part. Raises MapError if the map's colors are not those that define the words."""
    colors = state.get("colors", state.get("colours"))  # earlier maps have the other spelling
    if state.get("terms") != list(TERMS) or colors != list(CENTROIDS):
        raise MapError("The map's color features are from another version of freeocc3d: reconstruct the map again.")
    return ColorWords()


def parse_colors(phrase: str) -> dict[str, Meaning | str]:
    """The colors in a phrase: "a dark-blue sofa" gives "dark blue". The value is the color's meaning, or its basic
    term."""
    meanings: dict[str, Meaning | str] = {}
    modifier = ""
    for token in re.findall(r"[a-z]+", phrase.lower()):
        prefix = next((m for m in MODIFIERS if token.startswith(m) and base_color(token.removeprefix(m))), "")
        color = base_color(token.removeprefix(prefix))
        if color:
            modifier = prefix or modifier
            plain = _SPELLINGS.get(color, color)
            meanings[f"{modifier} {color}".strip()] = MODIFIERS.get(modifier, {}).get(plain, NAMES.get(plain, plain))
        modifier = token if token in MODIFIERS else ""
    return meanings


def encode_colors(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(..., 3) sRGB to (..., D) features, without a correction of colors."""
    bins = _channel_bins(None)
    return np.sqrt(_table()[bins[0][rgb[..., 0]] + bins[1][rgb[..., 1]] + bins[2][rgb[..., 2]]])


def base_color(token: str) -> str:
    """The color name that a lower-case token is a form of ("reddish", "greys", "redcolored"), or an empty string."""
    for ending in ("", "s", "coloured", "colored"):
        if _is_color(token.removesuffix(ending)):
            return token.removesuffix(ending)
    if not token.endswith("ish"):
        return ""
    stem = token.removesuffix("ish")  # "green(ish)", "blu(ish)" without its e, "red-d(ish)"
    return next((word for word in (stem, stem + "e", stem[:-1]) if _is_color(word)), "")


def _is_color(word: str) -> bool:
    return word in TERMS or word in NAMES or word in _SPELLINGS


def features_squared(m: NDArray[np.floating]) -> NDArray[np.floating]:
    """(..., C) memberships in the colors to (..., D) squared features (mu, m) / 2."""
    return np.concatenate((m @ _shares().T, m), axis=-1) / 2


def _shares() -> NDArray[np.float64]:
    """M: (terms, colors), columns sum to 1."""
    return np.array([[term.get(color, 0.0) for color in CENTROIDS] for term in TERMS.values()])


def _text_squared(meaning: Meaning | str) -> NDArray[np.floating]:
    """(D,) squared text feature of a meaning, or of a basic term."""
    if isinstance(meaning, str):
        return np.array([*(float(term == meaning) for term in TERMS), *(0.0 for _ in CENTROIDS)])
    q = np.array([meaning.get(color, 0.0) for color in CENTROIDS])
    q /= q.sum()
    return np.concatenate((_TERM_SHARE * _shares() @ q, (1 - _TERM_SHARE) * q))


def memberships(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """(..., 3) sRGB in 0…255 to (..., C) memberships in the colors of CENTROIDS; they sum to 1."""
    lab = rgb_to_lab(rgb)
    squared = np.stack(
        [np.min([_squared_cie94(lab, c) for c in centroids], axis=0) for centroids in CENTROIDS.values()], axis=-1
    )
    m = np.exp(-0.5 * (squared - squared.min(axis=-1, keepdims=True)) / _SIGMA**2)
    return np.asarray(m / m.sum(axis=-1, keepdims=True))


def rgb_to_lab(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """(..., 3) sRGB in 0…255 to CIELAB under D65 (IEC 61966-2-1, CIE 15)."""
    to_xyz = np.array(
        ((0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041))
    )
    xyz = _linear(np.asarray(rgb, np.float64) / 255.0) @ (to_xyz / to_xyz.sum(axis=1, keepdims=True)).T
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), axis=-1)


def _squared_cie94(lab: NDArray[np.float64], centroid: tuple[float, float, float]) -> NDArray[np.float64]:
    """(...,) squared CIE94 difference of (..., 3) colors to a centroid (lightness, chroma, hue in degrees)."""
    L, a, b = np.moveaxis(lab, -1, 0)
    L_c, C_c, hue = centroid[0], centroid[1], np.radians(centroid[2])
    squared_dC = (np.hypot(a, b) - C_c) ** 2
    squared_dH = np.maximum((a - C_c * np.cos(hue)) ** 2 + (b - C_c * np.sin(hue)) ** 2 - squared_dC, 0.0)
    S_C, S_H = 1 + 0.045 * C_c, 1 + 0.015 * C_c
    return np.asarray((_LIGHTNESS_WEIGHT * (L - L_c)) ** 2 + squared_dC / S_C**2 + squared_dH / S_H**2)


def _table() -> NDArray[np.float32]:
    """(32768, D) squared features of the centers of 32 x 32 x 32 bins of sRGB, red slowest."""
    centers = (np.arange(1 << _TABLE_BITS) + 0.5) * (256 >> _TABLE_BITS) - 0.5
    rgb = np.stack(np.meshgrid(centers, centers, centers, indexing="ij"), axis=-1)
    return features_squared(memberships(rgb.reshape(-1, 3))).astype(np.float32)


def _channel_bins(white: tuple[float, float, float] | None) -> NDArray[np.int32]:
    """(3, 256) the part of each channel value in the row index of the look-up table. Linear light is divided by that of
    ``white``: a von Kries adaptation at no cost."""
    gain = 1.0 / _linear(np.asarray(white or (255.0, 255.0, 255.0)) / 255.0)
    linear = np.minimum(_linear(np.arange(256) / 255.0) * gain[:, None], 1.0)
    srgb = np.where(linear > 0.0031308, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055, 12.92 * linear)
    bins = np.rint(srgb * 255).astype(np.int32) >> (8 - _TABLE_BITS)
    return bins << (_TABLE_BITS * np.array([2, 1, 0], np.int32))[:, None]


def _linear(srgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """sRGB in 0…1 to linear light."""
    return np.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)
