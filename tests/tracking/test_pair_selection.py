"""Pairs of images to compare, from given similarities and from descriptors."""

from __future__ import annotations

import numpy as np
import pytest

from freeocc3d.tracking.sfm import pair_selection


def alike_of(count: int, entries: dict[tuple[int, int], float]) -> np.ndarray:
    found = np.full((count, count), 0.1, np.float32)
    np.fill_diagonal(found, 1.0)
    for (i, j), value in entries.items():
        found[i, j] = found[j, i] = value
    return found


def test_each_image_is_paired_with_the_next_and_with_the_most_similar_ones_elsewhere() -> None:
    alike = alike_of(8, {(0, 1): 0.95, (0, 5): 0.9, (0, 4): 0.8, (2, 6): 0.7, (3, 7): 0.6, (1, 4): 0.5})
    found = [tuple(pair) for pair in pair_selection.choose_pairs(alike, 1, 1).tolist()]
    near = [(n, n + 1) for n in range(7)]
    assert found[:7] == near, "those that are closest in order come first"
    assert {(0, 5), (0, 4), (2, 6), (3, 7)} <= set(found)  # 4's best is 0
    assert (1, 4) in found  # 1's best elsewhere is 4, for 0 follows it
    gaps = [j - i for i, j in found]
    assert gaps == sorted(gaps)
    assert len(set(found)) == len(found)


@pytest.mark.parametrize(("follow", "retrieved", "count"), [(0, 0, 0), (2, 0, 13), (7, 0, 28), (0, 7, 28), (0, 99, 28)])
def test_as_many_pairs_as_asked_for(follow: int, retrieved: int, count: int) -> None:
    assert len(pair_selection.choose_pairs(alike_of(8, {}), follow, retrieved)) == count


@pytest.mark.parametrize(("better", "expected"), [(4, True), (5, False)])
def test_in_a_video_the_next_image_is_among_the_five_most_similar(better: int, expected: bool) -> None:
    """``better`` others look more alike than the next image, for every image."""
    count = 30
    alike = np.full((count, count), 0.1)
    for n in range(count):
        others = [(n + 10 + k) % count for k in range(better)]
        alike[n, others] = 0.9
        alike[n, (n + 1) % count] = 0.5
    np.fill_diagonal(alike, 1.0)
    assert pair_selection.is_sequence(alike) == expected


def test_ten_images_are_too_few_for_a_video() -> None:
    entries = {(n, n + 1): 0.9 for n in range(10)}
    assert pair_selection.is_sequence(alike_of(11, entries))
    assert not pair_selection.is_sequence(alike_of(10, {pair: 0.9 for pair in entries if pair[1] < 10}))


def test_a_description_is_the_residuals_to_the_nearest_words() -> None:
    rng = np.random.default_rng(0)
    words = rng.normal(size=(5, 8)).astype(np.float32)
    descriptors = rng.normal(size=(40, 8)).astype(np.float32)
    nearest = np.linalg.norm(descriptors[:, None] - words, axis=2).argmin(axis=1)
    sums = np.stack([(descriptors[nearest == n] - words[n]).sum(axis=0) for n in range(5)])
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    sums = (sums / np.where(lengths > 0, lengths, 1)).ravel()
    np.testing.assert_allclose(pair_selection._vlad(descriptors, words), sums / np.linalg.norm(sums), atol=1e-5)
    assert not pair_selection._vlad(descriptors[:0], words).any()


def test_images_of_the_same_things_are_alike() -> None:
    rng = np.random.default_rng(0)
    things = rng.normal(size=(3, 200, 16))
    things /= np.linalg.norm(things, axis=2, keepdims=True)
    images = [things[0, :150], things[0, 50:], things[1], things[2]]
    alike = pair_selection.compare_images([image.astype(np.float32) for image in images])
    np.testing.assert_allclose(np.diag(alike), 1.0, atol=1e-5)
    np.testing.assert_allclose(alike, alike.T, atol=1e-6)
    assert alike[0, 1] > max(alike[0, 2], alike[1, 3], alike[2, 3]) + 0.2
