"""Decisions on the way to a reconstruction: pairs, cameras, what is apart. The tracker's test runs COLMAP itself."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from freeocc3d.core.progress import Progress
from freeocc3d.tracking.sfm import pair_selection, structure_from_motion
from freeocc3d.tracking.sfm.structure_from_motion import Recipe


def models(*frames: list[int]) -> list:
    """Models by the frames that they place; image n + 1 is frame n."""
    return [SimpleNamespace(reg_image_ids=lambda own=own: [frame + 1 for frame in own]) for own in frames]


@pytest.mark.parametrize(
    ("others", "apart", "pieces"),
    [
        ([], [], 0),
        ([[10, 11, 12, 13, 14]], [10, 11, 12, 13, 14], 1),
        ([[10, 11, 12, 13]], [], 0),  # too few
        ([[3, 10, 11, 12, 13]], [], 0),  # one is in the largest model
        ([[10, 11, 12, 13, 14], [10, 11, 12, 13, 14, 15]], [10, 11, 12, 13, 14], 1),  # one more of its own
        ([[10, 11, 12, 13, 14], [15, 16, 17, 18, 19]], list(range(10, 20)), 2),
    ],
)
def test_frames_of_other_models_are_apart_if_there_are_five_of_their_own(others, apart, pieces: int) -> None:
    has_pose = np.isin(np.arange(20), range(8))
    found, count = structure_from_motion._apart(models(list(range(8)), *others), has_pose)
    assert np.flatnonzero(found).tolist() == apart
    assert count == pieces


@pytest.mark.parametrize(
    ("intrinsics", "known", "model"),
    [
        ("fixed", True, "PINHOLE"),
        ("fixed", False, "PINHOLE"),
        ("refine", True, "SIMPLE_PINHOLE"),
        ("refine", False, "SIMPLE_RADIAL"),
    ],
)
def test_the_camera_model_follows_from_what_is_known(intrinsics: str, known: bool, model: str) -> None:
    capture = SimpleNamespace(intrinsics_known=known)
    assert structure_from_motion._model(capture, Recipe(intrinsics=intrinsics)) == model  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("order", "like_a_video", "count", "chosen"),
    [
        ("video", False, 12, (5, 8)),
        ("auto", True, 12, (5, 8)),
        ("auto", False, 12, (0, 11)),
        ("unordered", True, 60, (0, 59)),
        ("unordered", True, 61, (0, 24)),
    ],
)
def test_videos_are_compared_along_the_way_and_photographs_with_those_alike(
    order: str, like_a_video: bool, count: int, chosen: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    sampled = []

    def compare_images(descriptors):
        sampled.extend(descriptors)
        return np.zeros((count, count))

    monkeypatch.setattr(pair_selection, "compare_images", compare_images)
    monkeypatch.setattr(pair_selection, "is_sequence", lambda alike: like_a_video)
    monkeypatch.setattr(pair_selection, "choose_pairs", lambda alike, follow, retrieved: (follow, retrieved))
    rows = np.arange(2400.0).reshape(1200, 2)
    found = structure_from_motion._pairs(lambda frame: rows, list(range(count)), order)
    assert found == chosen
    assert len(sampled) == count
    for one in sampled:
        assert len(np.unique(one[:, 0])) == len(one) == 1000  # so many suffice, and none twice


def test_only_pairs_that_were_not_yet_verified_are_matched(monkeypatch: pytest.MonkeyPatch) -> None:
    proposed = np.array([(0, 1), (1, 2), (0, 2)])
    added, told = [], []
    database = SimpleNamespace(
        descriptors=lambda frame: np.full((1, 1), frame),
        verified=lambda: {(10, 20)},
        add_matches=lambda pairs, matches: added.extend(zip(pairs, matches, strict=True)),
    )
    monkeypatch.setattr(structure_from_motion, "_pairs", lambda descriptors, frames, order: proposed)
    monkeypatch.setattr(
        structure_from_motion, "match_descriptors", lambda a, b, ratio: (int(a[0, 0]), int(b[0, 0]), ratio)
    )

    class Told(Progress):
        def advance(self, done: int) -> None:
            told.append(done)

    structure_from_motion._compare(database, [10, 20, 30], "auto", 0.8, Told())  # type: ignore[arg-type]
    assert added == [((20, 30), (20, 30, 0.8)), ((10, 30), (10, 30, 0.8))]
    assert told == [3]
