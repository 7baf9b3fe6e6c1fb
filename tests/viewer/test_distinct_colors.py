"""Distinct colors: far from each other and from a pale map, for every kind of color vision that is common."""

from types import SimpleNamespace

import numpy as np
import pytest

from freeocc3d.viewer import distinct_colors as module
from freeocc3d.viewer.distinct_colors import GENERATED, distinct_colors, every_color, measure_distances, pale_colors
from freeocc3d.viewer.palette import assign_class_colors, highlight_regions, word_colors


def least_distance(colors) -> float:
    return float((measure_distances(colors, colors) + np.diag(np.full(len(colors), np.inf))).min())


@pytest.mark.parametrize("count", range(1, 31))
def test_colors_of_words_are_apart_and_apart_from_a_pale_map_in_all_three_visions(count) -> None:
    colors = distinct_colors(count)
    assert colors.shape == (count, 3)
    if count > 1:
        assert least_distance(colors) >= (0.1 if count <= 8 else 0.04)
    assert measure_distances(colors, pale_colors(every_color(9))).min() >= 0.08
    np.testing.assert_array_equal(colors, distinct_colors(30)[:count])


def test_no_color_repeats_whatever_the_count() -> None:
    assert len(np.unique(distinct_colors(GENERATED + 3000), axis=0)) == GENERATED + 3000
    assert distinct_colors(0).shape == (0, 3)


def test_colors_that_color_blind_people_confuse_are_near() -> None:
    """Pairs that the literature names, and a pair that nobody confuses."""
    red, green, blue = np.array(((185, 80, 40), (115, 120, 40), (0, 0, 255)), np.uint8)[:, None]
    normal = np.linalg.norm(module._seen(red)[0] - module._seen(green)[0])
    assert normal > 0.1
    assert measure_distances(red, green)[0, 0] < 0.5 * normal
    assert measure_distances(red, blue)[0, 0] > 0.3


def test_black_and_white_are_the_ends_of_the_lightness_in_each_vision() -> None:
    seen = module._seen(np.array(((0, 0, 0), (255, 255, 255)), np.uint8))
    np.testing.assert_allclose(seen, np.tile(np.array(((0, 0, 0), (0.7, 0, 0))), (3, 1, 1)), atol=2e-3)


@pytest.mark.parametrize(("count", "apart"), [(2, 0.06), (40, 0.045), (100, 0.03), (253, 0.01)])
def test_no_two_classes_of_a_map_look_alike(count, apart) -> None:
    names = [f"class {number}" for number in range(count)]
    assert least_distance(assign_class_colors(names)) >= apart


def test_a_class_keeps_its_color_where_none_looks_alike() -> None:
    names = [f"class {number}" for number in range(60)]
    together = assign_class_colors(names)
    kept = []
    for row, name in enumerate(names, 1):
        alone = assign_class_colors([name])[1]
        kept.append(bool((together[row] == alone).all()))
        assert kept[-1] == (measure_distances(alone[None], together[:row]).min() >= 0.05)
    assert set(kept) == {True, False}
    np.testing.assert_array_equal(
        assign_class_colors(["wall", "x", "wall"])[[1, 3]], [assign_class_colors(["wall"])[1]] * 2
    )


def test_of_two_regions_in_one_place_the_smaller_one_is_seen() -> None:
    def region(*rows):
        return SimpleNamespace(rows=np.array(rows))

    gray = np.full((6, 3), 128, np.uint8)
    first, second, third = distinct_colors(3)
    words = [[region(0, 1, 2, 3)], [region(1)], [region(0, 1, 2, 3), region(4)]]
    colors = highlight_regions(gray, words)
    np.testing.assert_array_equal(colors[:5], [first, second, first, first, third])
    np.testing.assert_array_equal(colors[5:], pale_colors(gray[:1]))


def test_words_that_found_something_have_the_first_colors() -> None:
    colors = word_colors([[], [SimpleNamespace()], [], [SimpleNamespace()]])
    np.testing.assert_array_equal(colors[[1, 3, 0, 2]], distinct_colors(4))
