"""Color names: the meaning of words, the names of surfaces under imperfect light, and the encoder's contract."""

from __future__ import annotations

import json

import numpy as np
import pytest

from freeocc3d.core.errors import ConfigError, MapError
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.language.encoders import color
from freeocc3d.language.encoders.color import CENTROIDS, MODIFIERS, NAMES, TERMS, ColorEncoder, Options, load_text
from freeocc3d.query.word_query import similarity

ENCODER = ColorEncoder()
WORDS = load_text(ENCODER.text_state())

SURFACES = {
    "red": (200, 30, 35),
    "yellow": (235, 200, 40),
    "white": (225, 222, 215),
    "brown": (130, 85, 50),
    "grey": (128, 128, 128),
    "blue": (40, 90, 190),
    "green": (50, 140, 70),
    "black": (25, 25, 28),
    "pink": (235, 150, 175),
    "orange": (240, 130, 30),
    "purple": (110, 50, 140),
    "turquoise": (50, 180, 175),
    "beige": (222, 205, 175),
}


def frame(rgb: object, size: tuple[int, int] = (8, 8)) -> Frame:
    width, height = size
    color = np.broadcast_to(np.clip(np.rint(np.asarray(rgb, float)), 0, 255).astype(np.uint8), (height, width, 3))
    return Frame(0, 0.0, color, np.ones((height, width), np.float32), Intrinsics(width, height, 10, 10, 4, 4))


def scores(rgb: object, words: list[str]) -> dict[str, float]:
    feature = ENCODER.encode(frame(rgb))[0]
    return dict(zip(words, similarity(feature, WORDS.encode_words(words))[0].tolist(), strict=True))


def called(rgb: object) -> str:
    named = scores(rgb, list(TERMS))
    best = max(named, key=lambda word: named[word])
    assert named[best] >= WORDS.threshold, (rgb, named)
    return best


@pytest.mark.parametrize("name", SURFACES)
def test_surfaces_are_called_what_people_call_them(name: str) -> None:
    assert called(SURFACES[name]) == name


@pytest.mark.parametrize("name", ["red", "yellow", "blue", "green", "purple", "turquoise", "brown", "black"])
@pytest.mark.parametrize("light", [(0.7, 0.7, 0.7), (1.0, 0.93, 0.82), (0.9, 0.96, 1.0)])
def test_chromatic_surfaces_keep_their_name_in_dim_and_tinted_light(name: str, light: tuple[float, ...]) -> None:
    assert called(np.array(SURFACES[name]) * light) == name


@pytest.mark.parametrize("wall", [(235, 228, 212), (205, 210, 212), (190, 188, 184)])
def test_white_walls_in_shade_and_warm_light_are_white(wall: tuple[int, ...]) -> None:
    assert called(wall) == "white"


def test_a_very_warm_wall_is_beige_rather_than_yellow_or_pink() -> None:
    assert called((225, 205, 172)) == "beige"


def test_white_option_adapts_to_the_light() -> None:
    light = np.array((1.0, 0.85, 0.6))
    adapted = ColorEncoder(Options(white=tuple(250 * light)))
    feature = adapted.encode(frame(np.array((220, 220, 220)) * light))[0]
    named = similarity(feature, WORDS.encode_words(list(TERMS)))[0]
    assert list(TERMS)[int(named.argmax())] == "white"


@pytest.mark.parametrize(
    ("shade", "other"),
    [
        ("dark blue", "light blue"),
        ("dark red", "bright red"),
        ("light green", "dark green"),
        ("dark grey", "light grey"),
        ("light brown", "dark brown"),
    ],
)
def test_modifiers_tell_shades_apart(shade: str, other: str) -> None:
    rgb = {
        "dark blue": (20, 30, 80), "dark red": (80, 12, 20), "light green": (150, 215, 150), "dark grey": (75, 75, 77),
        "light brown": (170, 120, 75),
    }[shade]  # fmt: skip
    named = scores(rgb, [shade, other, shade.split()[-1]])
    assert named[shade] >= WORDS.threshold > named[other]
    assert named[shade.split()[-1]] > 0.8  # dark blue is blue


@pytest.mark.parametrize(
    ("phrase", "understood"),
    [
        ("red", "red"),
        ("Red Cup", "red"),
        ("a DARK-BLUE sofa", "dark blue"),
        ("darkblue", "dark blue"),
        ("pale-green walls", "pale green"),
        ("reddish", "red"),
        ("bluish", "blue"),
        ("whitish", "white"),
        ("purplish", "purple"),
        ("greys", "grey"),
        ("gray", "gray"),
        ("red-coloured", "red"),
        ("navy", "navy"),
        ("red and white cloth", "red, white"),
        ("sofa", ""),
        ("dark", ""),
        ("", ""),
        ("redo", ""),
        ("predator", ""),
    ],
)
def test_understood(phrase: str, understood: str) -> None:
    text = WORDS.encode_words([phrase])
    assert text.understood == (understood,)
    assert np.linalg.norm(text.features[0]) == pytest.approx(1 if understood else 0, abs=1e-5)


def test_spellings_mean_the_same() -> None:
    grey, gray, dark, deep = WORDS.encode_words(["grey", "gray", "dark blue", "deep-blue"]).features
    np.testing.assert_array_equal(grey, gray)
    np.testing.assert_array_equal(dark, deep)


def test_a_phrase_of_two_colors_finds_things_of_either() -> None:
    for name in ("red", "white"):
        assert scores(SURFACES[name], ["red and white"])["red and white"] > 0.9
    assert scores(SURFACES["blue"], ["red and white"])["red and white"] < 0.3


def test_every_word_is_reached_by_some_color_and_competes_with_others_only() -> None:
    modified = [f"{modifier} {base}" for modifier, meanings in MODIFIERS.items() for base in meanings]
    words = [*TERMS, *NAMES, *modified]
    text = WORDS.encode_words(words)
    assert all(text.understood)
    pure = np.sqrt(color.features_squared(np.eye(len(CENTROIDS))))
    np.testing.assert_allclose(similarity(pure, text).max(axis=0), 1, atol=1e-5)
    terms = WORDS.encode_words(WORDS.contrast_words()).features
    for word, row in zip(words, text.features @ terms.T, strict=True):
        assert row.max() >= WORDS.same_word, word  # the term that the word is a shade of does not compete


def test_meanings_name_colors_that_exist() -> None:
    for meaning in (*TERMS.values(), *NAMES.values(), *(m for table in MODIFIERS.values() for m in table.values())):
        assert set(meaning) <= set(CENTROIDS)
    for table in MODIFIERS.values():
        assert set(table) <= set(TERMS)


def test_features_are_unit_at_a_quarter_of_the_resolution() -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (50, 71, 3)).astype(np.uint8)
    features = ENCODER.encode(Frame(0, 0.0, color, np.ones((50, 71), np.float32), Intrinsics(71, 50, 9, 9, 9, 9)))
    assert features.shape == (13, 18, ENCODER.dimension)
    assert features.dtype == np.float16
    np.testing.assert_allclose(np.linalg.norm(features.astype(np.float64), axis=2), 1, atol=2e-3)


@pytest.mark.parametrize("stride", [1, 2, 3, 4])
def test_blocks_lie_where_their_pixels_are(stride: int) -> None:
    color = np.zeros((12, 24, 3), np.uint8)
    color[:, :12] = SURFACES["red"]
    color[:, 12:] = SURFACES["blue"]
    pixels = Frame(0, 0.0, color, np.ones((12, 24), np.float32), Intrinsics(24, 12, 9, 9, 9, 9))
    features = ColorEncoder(Options(stride=stride)).encode(pixels)
    named = similarity(features.reshape(-1, features.shape[2]), WORDS.encode_words(["red", "blue"]))
    best = named.argmax(axis=1).reshape(features.shape[:2])
    half = features.shape[1] // 2
    assert not best[:, :half].any()
    assert best[:, half:].all()


def test_look_up_table_agrees_with_the_formula() -> None:
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 32, (200, 3)) * 8 + 4
    exact = np.sqrt(color.features_squared(color.memberships(rgb.astype(float))))
    looked_up = np.array([ENCODER.encode(frame(pixel))[0, 0] for pixel in rgb])
    assert (exact * looked_up).sum(axis=1).min() > 0.99


def test_lab_of_reference_colors() -> None:
    """Values of the sRGB primaries in CIELAB (D65), as color tables give them."""
    rgb = np.array([(255, 255, 255), (0, 0, 0), (255, 0, 0), (0, 255, 0), (0, 0, 255)], float)
    expected = [(100, 0, 0), (0, 0, 0), (53.24, 80.09, 67.20), (87.73, -86.18, 83.18), (32.30, 79.19, -107.86)]
    np.testing.assert_allclose(color.rgb_to_lab(rgb), expected, atol=0.05)


def test_state_is_plain_and_restores_the_words() -> None:
    state = json.loads(json.dumps(ENCODER.text_state()))
    np.testing.assert_array_equal(
        load_text(state).encode_words(["teal"]).features, WORDS.encode_words(["teal"]).features
    )


@pytest.mark.parametrize("state", [{}, {"terms": ["red"]}, {"terms": list(TERMS), "colours": ["red"]}])
def test_a_map_with_other_colors_is_refused(state: dict) -> None:
    with pytest.raises(MapError, match="reconstruct the map again"):
        load_text(state)


@pytest.mark.parametrize("bad", [{"stride": 0}, {"white": (0.0, 200.0, 200.0)}, {"white": (256.0, 200.0, 200.0)}])
def test_options_out_of_range_are_refused(bad: dict) -> None:
    with pytest.raises(ConfigError):
        Options(**bad)


def test_centroids_are_colors() -> None:
    """Lightness, chroma and hue in their ranges, and the vivid ones of a name within a sixth of the circle."""
    for name, centroids in CENTROIDS.items():
        for lightness, chroma, hue in centroids:
            assert 0 <= lightness <= 100, name
            assert 0 <= chroma <= 135, name
            assert 0 <= hue < 360, name
        vivid = np.array([hue for _, chroma, hue in centroids if chroma > 12])
        apart = np.abs(np.subtract.outer(vivid, vivid))
        assert np.minimum(apart, 360 - apart).max(initial=0) <= 60, name
