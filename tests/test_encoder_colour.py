"""Colour names: pixels, words, and that each finds its own."""

import numpy as np
import pytest
from scenes import CAMERA

from freeocc3d.language.encoders import colour
from freeocc3d.types import Frame

ENCODER, WORDS = colour.load(None), colour.load_text({})


def feature_of(rgb) -> np.ndarray:
    image = np.broadcast_to(np.uint8(rgb), (CAMERA.height, CAMERA.width, 3)).copy()
    return ENCODER.encode(Frame(0, 0.0, image, np.zeros(image.shape[:2], np.float32), CAMERA))[0, 0].astype(float)


def best_name(rgb, names=colour.TERMS) -> str:
    return names[int(np.argmax(WORDS.encode_words(list(names)).features @ feature_of(rgb)))]


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((220, 30, 35), "red"), ((120, 20, 24), "red"), ((245, 210, 40), "yellow"), ((40, 150, 70), "green"),
        ((30, 80, 200), "blue"), ((20, 30, 80), "blue"), ((250, 250, 250), "white"), ((205, 204, 200), "white"),
        ((128, 128, 130), "grey"), ((14, 14, 16), "black"), ((110, 70, 40), "brown"), ((245, 140, 30), "orange"),
        ((110, 45, 150), "purple"), ((245, 150, 190), "pink"), ((30, 175, 175), "turquoise"),
        ((222, 200, 165), "beige"),
    ],
)  # fmt: skip
def test_a_colour_gets_its_name(rgb, name) -> None:
    assert best_name(rgb) == name


@pytest.mark.parametrize(("rgb", "name"), [((215, 30, 35), "red"), ((240, 205, 40), "yellow"), ((35, 85, 200), "blue")])
def test_a_name_survives_shade_and_warm_light(rgb, name) -> None:
    for light in ((1, 1, 1), (0.65, 0.65, 0.65), (1.0, 0.92, 0.8)):
        assert best_name(np.clip(np.multiply(rgb, light), 0, 255)) == name


def test_tones_are_told_apart() -> None:
    names = ("dark blue", "light blue")
    assert best_name((20, 32, 96), names) == "dark blue"
    assert best_name((140, 190, 240), names) == "light blue"
    dark = WORDS.encode_words(["dark blue"]).features[0]
    assert dark @ feature_of((20, 32, 96)) > WORDS.threshold > dark @ feature_of((140, 190, 240))


def test_features_are_unit_and_cover_the_image() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3)).astype(np.uint8)
    features = ENCODER.encode(Frame(0, 0.0, image, np.zeros(image.shape[:2], np.float32), CAMERA))
    assert features.shape == (CAMERA.height // 4, CAMERA.width // 4, ENCODER.dimension)
    np.testing.assert_allclose(np.linalg.norm(features.astype(float), axis=-1), 1.0, atol=2e-3)


@pytest.mark.parametrize("size", [(7, 5), (3, 2), (161, 121)])
def test_odd_image_sizes_are_fine(size) -> None:
    image = np.full((size[1], size[0], 3), 200, np.uint8)
    features = ENCODER.encode(Frame(0, 0.0, image, np.zeros(image.shape[:2], np.float32), CAMERA))
    assert features.ndim == 3
    assert features.size > 0


@pytest.mark.parametrize(
    ("phrase", "understood"),
    [
        ("white sofa", "white"), ("Dark-Blue", "dark blue"), ("a pale green wall", "light green"), ("gray", "grey"),
        ("navy", "dark blue"), ("reddish", "red"), ("whitish", "white"), ("greens", "green"), ("crimson cup", "red"),
        ("sofa", ""), ("dark", ""), ("", ""), ("белый", ""), ("red and white", "red white"),
    ],
)  # fmt: skip
def test_phrases_are_understood_as_far_as_they_name_colours(phrase, understood) -> None:
    text = WORDS.encode_words([phrase])
    assert text.understood == (understood,)
    assert np.linalg.norm(text.features[0]) == pytest.approx(1.0 if understood else 0.0, abs=1e-6)


def test_lab_of_white_black_and_red_is_the_standards() -> None:
    lab = colour.rgb_to_lab(np.array([[255, 255, 255], [0, 0, 0], [255, 0, 0]], float))
    np.testing.assert_allclose(lab, [[100, 0, 0], [0, 0, 0], [53.24, 80.09, 67.20]], atol=0.02)


def test_memberships_sum_to_one() -> None:
    rgb = np.random.default_rng(1).uniform(0, 255, (200, 3))
    np.testing.assert_allclose(colour.memberships(rgb).sum(axis=1), 1.0, rtol=1e-5)
