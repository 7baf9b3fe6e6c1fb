"""Scores of hand-counted cases."""

import numpy as np
import pytest
from numpy.typing import NDArray

from freeocc3d.core.errors import FreeOccError
from freeocc3d.evaluation.confusion import Prediction, Scores, count_confusion

NAMES = ("wall", "floor", "sofa", "lamp")


def scores(labels: object, occupied: object, classes: object = None, names: tuple[str, ...] = NAMES) -> Scores:
    """Of lists of voxels; 255 is outside the mask."""
    true = np.array(labels, np.uint8).reshape(-1, 1, 1)
    claimed = None if classes is None else np.array(classes, np.uint8).reshape(true.shape)
    predicted = Prediction(np.array(occupied, bool).reshape(true.shape), claimed)
    return Scores(count_confusion(true, predicted, true != 255, len(names)), names)


def test_occupancy_counted_by_hand() -> None:
    score = scores([1, 2, 3, 4, 0, 0, 255, 255], [1, 1, 1, 0, 1, 0, 1, 0])
    assert score.iou == pytest.approx(3 / 5)
    assert score.precision == pytest.approx(3 / 4)
    assert score.recall == pytest.approx(3 / 4)
    assert score.voxels == 6


def test_precision_and_recall_are_not_exchanged() -> None:
    score = scores([1, 1, 1, 0], [1, 0, 0, 0])
    assert (score.precision, score.recall) == (1.0, pytest.approx(1 / 3))


def test_classes_counted_by_hand() -> None:
    #          hit, hit, taken for floor, missed | hit, without class | invented wall | free
    truth = [1, 1, 1, 1, 2, 2, 0, 0]
    occupied = [1, 1, 1, 0, 1, 1, 1, 0]
    classes = [1, 1, 2, 0, 2, 0, 1, 0]
    score = scores(truth, occupied, classes)
    # wall: 2 hits, of 4 true and 3 claimed; floor: 1 hit, of 2 true and 2 claimed.
    np.testing.assert_allclose(score.class_iou, [2 / 5, 1 / 3, 0, 0])
    assert score.miou(("wall", "floor")) == pytest.approx((2 / 5 + 1 / 3) / 2)
    assert score.miou(NAMES) == pytest.approx((2 / 5 + 1 / 3) / 4)  # absent classes count 0
    assert score.present == ("wall", "floor")
    assert score.most_frequent(1) == ("wall",)
    expected = np.zeros((5, 6), int)
    expected[0, [0, 1]] = 1
    expected[1, [0, 1, 2]] = 1, 2, 1
    expected[2, [2, 5]] = 1
    np.testing.assert_array_equal(score.matrix, expected)


def test_pooling_adds_voxels_not_scores() -> None:
    one, two = scores([1, 1, 1, 0], [1, 1, 1, 1], [1, 1, 1, 1]), scores([1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0])
    pooled = Scores(one.matrix + two.matrix, NAMES)
    assert pooled.iou == pytest.approx(3 / 5)
    assert pooled.class_iou[0] == pytest.approx(3 / 5)


def test_a_class_claimed_where_nothing_is_occupied_does_not_count() -> None:
    assert scores([1, 0], [0, 0], [1, 1]).class_iou[0] == 0.0
    np.testing.assert_array_equal(scores([1, 0], [0, 0], [1, 1]).matrix[:, 1:], 0)


def test_what_was_not_observed_does_not_count() -> None:
    rng = np.random.default_rng(0)
    labels = rng.choice(np.array([0, 1, 2, 255], np.uint8), 300)
    occupied, classes = rng.random(300) < 0.5, rng.integers(0, 3, 300)
    other = np.where(labels == 255, ~occupied, occupied)
    np.testing.assert_array_equal(scores(labels, occupied, classes).matrix, scores(labels, other, classes).matrix)


def test_the_order_of_voxels_does_not_count() -> None:
    rng = np.random.default_rng(1)
    labels, occupied, classes = rng.integers(0, 5, 400), rng.random(400) < 0.5, rng.integers(0, 5, 400)
    order = rng.permutation(400)
    shuffled = scores(labels[order], occupied[order], classes[order])
    np.testing.assert_array_equal(scores(labels, occupied, classes).matrix, shuffled.matrix)


@pytest.mark.parametrize("names", [NAMES, ("occupied",)])
def test_the_truth_as_prediction_scores_one_everywhere(names: tuple[str, ...]) -> None:
    labels = np.random.default_rng(2).integers(0, len(names) + 1, 500)
    score = scores(labels, labels > 0, labels, names)
    assert (score.iou, score.precision, score.recall) == (1.0, 1.0, 1.0)
    assert score.miou(score.present) == 1.0


def test_empty_and_opposite_predictions_score_zero() -> None:
    labels = np.array([0, 1, 3, 0])
    assert scores(labels, labels == 0).iou == 0.0
    empty = scores(labels, np.zeros(4))
    assert (empty.iou, empty.precision, empty.recall) == (0.0, 0.0, 0.0)


def cube(shift: int = 0) -> NDArray[np.uint8]:
    """A solid cube of 4 voxels' edge in a grid of 10, shifted along the first axis."""
    labels = np.zeros((10, 10, 10), np.uint8)
    labels[2 + shift : 6 + shift, 2:6, 2:6] = 1
    return labels


def test_a_shift_by_one_voxel_costs_what_the_overlap_says() -> None:
    moved = scores(cube().ravel(), cube(1).ravel() > 0, cube(1).ravel(), ("box",))
    # 3 of 4 slices overlap; together they are 5.
    assert moved.iou == pytest.approx(3 / 5)
    assert moved.precision == moved.recall == pytest.approx(3 / 4)
    assert moved.miou(("box",)) == pytest.approx(3 / 5)


def test_a_swapped_axis_costs_what_the_overlap_says() -> None:
    bar = np.zeros((10, 10, 10), bool)
    bar[1:9, 4:6, 4:6] = True
    swapped = bar.swapaxes(0, 1)
    # Two bars of 8 x 2 x 2 that cross in a cube of 2 x 2 x 2.
    assert scores(bar.ravel().astype(int), swapped.ravel()).iou == pytest.approx(8 / (32 + 32 - 8))


def test_a_prediction_on_another_lattice_is_refused() -> None:
    with pytest.raises(FreeOccError, match=r"\(2, 2, 3\)"):
        count_confusion(
            np.zeros((2, 2, 2), np.uint8), Prediction(np.zeros((2, 2, 3), bool)), np.ones((2, 2, 2), bool), 1
        )


def test_voxel_states_are_not_taken_for_a_prediction() -> None:
    states = np.full((2, 2, 2), 255, np.uint8)
    with pytest.raises(FreeOccError, match="boolean"):
        count_confusion(np.zeros((2, 2, 2), np.uint8), Prediction(states), np.ones((2, 2, 2), bool), 1)  # type: ignore[arg-type]


def test_a_truth_that_observed_nothing_is_refused() -> None:
    with pytest.raises(FreeOccError, match="observed no voxel"):
        scores([255, 255], [0, 1])


def test_a_label_without_a_name_is_refused() -> None:
    with pytest.raises(FreeOccError, match="label is 5"):
        scores([1, 2], [1, 1], [1, 5])
