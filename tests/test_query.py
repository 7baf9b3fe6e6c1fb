"""Words to voxels to regions."""

import json
from pathlib import Path

import numpy as np
import pytest
from scenes import occupancy_of

from freeocc3d import query
from freeocc3d.errors import ConfigError, FreeOccError
from freeocc3d.language.encoders.labels import load_text

WORDS = load_text({"classes": ["nothing", "cup", "table"]})


def block(low, high) -> list[tuple[int, int, int]]:
    return [tuple(v) for v in np.indices(np.subtract(high, low)).reshape(3, -1).T + low]


def two_cups_and_a_table():
    """Cups of 8 and 3 voxels, apart, one at negative indices across a block's border; a table of 12."""
    first, second, table = block((-1, 7, 3), (1, 9, 5)), block((20, 0, 0), (23, 1, 1)), block((10, 0, 0), (14, 3, 1))
    features = [[1, 0]] * 8 + [[1, 0]] * 3 + [[0, 1]] * 12
    return occupancy_of([*first, *second, *table], features, origin=(1.0, 0, 0))


def ask(occupancy, word: str, **options) -> query.QueryResult:
    return query.query(occupancy, WORDS, [word], query.Options(**options))[0]


def test_regions_have_the_right_voxels_boxes_centroids_and_volumes() -> None:
    occupancy = two_cups_and_a_table()
    result = ask(occupancy, "cup")
    assert [region.voxels for region in result.regions] == [8, 3]
    large, small = result.regions
    np.testing.assert_allclose(large.box_min, (0.9, 0.7, 0.3))
    np.testing.assert_allclose(large.box_max, (1.1, 0.9, 0.5))
    np.testing.assert_allclose(large.centroid, (1.0, 0.8, 0.4))
    assert large.volume_m3 == pytest.approx(8e-3)
    np.testing.assert_allclose(small.box_min, (3.0, 0.0, 0.0))
    np.testing.assert_allclose(small.box_max, (3.3, 0.1, 0.1))
    assert large.score == pytest.approx(1.0, abs=1e-3)
    assert large.confidence > 0.99
    assert result.matched
    assert result.note == ""


def test_voxels_touching_at_a_corner_belong_together_and_components_equal_a_dense_labelling() -> None:
    from scipy import ndimage

    rng = np.random.default_rng(0)
    grid = rng.random((14, 13, 12)) < 0.12
    voxels = np.argwhere(grid).astype(np.int32) - 6
    component = query.connected(voxels)
    expected, n = ndimage.label(grid, np.ones((3, 3, 3)))
    assert component.max() + 1 == n
    pairs = {(a, b) for a, b in zip(component.tolist(), expected[grid].tolist(), strict=True)}
    assert len(pairs) == n


def test_what_nothing_matches_says_so() -> None:
    occupancy = two_cups_and_a_table()
    for word, part in (("unicorn", "Nothing is known of 'unicorn'"), ("white cupboard", "Nothing is known")):
        result = ask(occupancy, word)
        assert not result.matched
        assert result.regions == []
        assert part in result.note
    only_table = occupancy_of(block((0, 0, 0), (2, 2, 2)), [[0, 1]] * 8)
    result = ask(only_table, "cup")
    assert not result.matched
    assert "Nothing in this map looks like 'cup'" in result.note
    assert "Only 'cup'" in ask(occupancy, "red cup").note


def test_a_voxel_that_is_more_something_else_does_not_match() -> None:
    mixed = occupancy_of(block((0, 0, 0), (2, 2, 2)), [[0.6, 0.8]] * 8)  # 0.6 reaches the threshold of 0.5
    assert not ask(mixed, "cup").matched
    assert ask(mixed, "table").matched


def test_specks_are_left_out_unless_there_is_nothing_else() -> None:
    speck = block((40, 0, 0), (41, 1, 1))
    features = [[1, 0]] * 9
    assert [r.voxels for r in ask(occupancy_of([*block((0, 0, 0), (2, 2, 2)), *speck], features), "cup").regions] == [8]
    assert [r.voxels for r in ask(occupancy_of(speck, [[1, 0]]), "cup").regions] == [1]


def test_options_threshold_and_top_k() -> None:
    occupancy = two_cups_and_a_table()
    assert len(ask(occupancy, "cup", top_k=1).regions) == 1
    weak = occupancy_of(block((0, 0, 0), (2, 2, 2)), [[0.4, 0.0]] * 8)
    assert not ask(weak, "cup").matched
    assert ask(weak, "cup", threshold=0.3).matched
    with pytest.raises(ConfigError):
        query.Options(top_k=0)


def test_unknown_features_match_nothing() -> None:
    assert not ask(occupancy_of(block((0, 0, 0), (2, 2, 2))), "cup", threshold=0.0001).matched


def test_an_empty_map_answers_and_bad_words_are_refused() -> None:
    empty = occupancy_of([])
    assert not ask(empty, "cup").matched
    with pytest.raises(FreeOccError, match="empty word"):
        ask(empty, "  ")
    with pytest.raises(FreeOccError, match="10000 characters"):
        ask(empty, "a" * 10_000)
    assert not ask(empty, "чашка 杯子").matched


def test_json_has_the_documented_keys_and_text_names_every_word() -> None:
    results = query.query(two_cups_and_a_table(), WORDS, ["cup", "unicorn"])
    document = json.loads(json.dumps(query.to_json(Path("maps/x"), results)))
    assert set(document) >= {"version", "map", "results"}
    assert [r["word"] for r in document["results"]] == ["cup", "unicorn"]
    assert [r["matched"] for r in document["results"]] == [True, False]
    assert document["results"][1]["regions"] == []
    assert set(document["results"][0]["regions"][0]) >= {
        "score", "confidence", "centroid", "box_min", "box_max", "volume_m3", "voxels",
    }  # fmt: skip
    text = query.to_text(results)
    assert "cup: 2 regions" in text
    assert "unicorn: no match" in text
