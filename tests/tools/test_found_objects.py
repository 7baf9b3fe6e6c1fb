"""The benchmark's objects: which things count, and which objects are right."""

import numpy as np
import pytest
from benchmark import objects

from freeocc3d.evaluation.true_occupancy import GroundTruth


def test_masks_are_split_joined_and_missing_at_random() -> None:
    classes = np.repeat(np.repeat(np.arange(16, dtype=np.uint8).reshape(4, 4) + 1, 8, axis=0), 8, axis=1)
    whole = objects.disturb_masks(classes, 0.0, np.random.default_rng(0))
    assert len(np.unique(np.stack((whole, classes)).reshape(2, -1), axis=1).T) == 16
    wrong = objects.disturb_masks(classes, 0.3, np.random.default_rng(0))
    both = np.unique(np.stack((wrong, classes)).reshape(2, -1), axis=1)
    assert (wrong == 0).any()
    assert np.bincount(both[0][both[0] > 0]).max() > 1  # a mask of several things
    assert np.bincount(both[1]).max() > 1  # a thing of several masks


def test_found_things_and_wrong_objects_are_counted_and_stuff_is_left_out() -> None:
    labels = np.zeros((40, 10, 10), np.uint8)
    instance = np.full(labels.shape, -1)
    labels[0:8, :, 0], instance[0:8, :, 0] = 1, 0  # a chair, found
    labels[10:18, :, 0], instance[10:13, :, 0] = 1, 1  # another one, three eighths of it found
    labels[20:28, :, 0], instance[20:28, :, 0] = 2, 2  # a wall: a mistake
    labels[30:38, :, 0], instance[30:38, :, 0] = 3, 3  # a window: neither right nor wrong
    labels[39, :5, 0], instance[39, :5, 0] = 1, 4  # a small chair
    labels[:, :, 9] = 255
    truth = GroundTruth(labels, np.zeros(3), 0.08, ("", "chair", "wall", "window"))
    found = objects.count_found(truth, instance >= 0, instance, objects.STUFF, alone=False)
    assert (found["things"], found["recall"], found["judged"], found["precision"]) == (2, 0.5, 2, 0.5)
    assert found["mean_iou"] == pytest.approx((1 + 3 / 8) / 2)
    assert found["missed"] == ["chair of 80 0.38"]
    assert found["wrong"] == ["80 voxels: no thing 80"]
    alone = objects.count_found(truth, instance >= 0, instance, (), alone=True)
    assert (alone["things"], alone["recall"], alone["precision"]) == (3, 1, 0.75)

    row = {"capture": "room", "colors, own poses": {"seconds": 2.0, **dict.fromkeys(objects.COUNTS, found)}}
    assert "| room | colors, own poses | 2 | 0.50 | 0.50 | 0.69 | 0.50 / 0.50 | 0.50 / 0.50 | 2.0 |" in (
        objects.tabulate_objects([row, {"capture": "x", "error": "lost"}])
    )
