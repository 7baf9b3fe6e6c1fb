"""The altered captures of the benchmark match their names, and its measurements are reported."""

import numpy as np
import pytest
from benchmark import tracking_stress
from scenes import wall_frame
from small_captures import data_folder


def test_sequences_are_what_their_names_say() -> None:
    sequences = tracking_stress.sequences(120)
    assert list(sequences["full"].frames) == list(range(120))
    assert list(sequences["every 3rd frame"].frames) == list(range(0, 120, 3))
    assert list(sequences["reversed"].frames) == list(range(119, -1, -1))
    assert [i for i in range(120) if i not in sequences["30 frames cut out"].frames] == list(range(60, 90))
    there_and_back = list(sequences["there and back"].frames)
    assert there_and_back == [*range(120), *range(118, -1, -1)]
    assert sequences["20 frames without anything"].lost == frozenset(range(60, 80))


def test_changes_touch_what_they_should() -> None:
    sequences, frame = tracking_stress.sequences(120), wall_frame(2.0)
    black = sequences["20 black frames"].change(70, frame)
    assert not black.color.any()
    np.testing.assert_array_equal(black.depth_m, frame.depth_m)
    assert sequences["20 black frames"].change(59, frame) is frame
    blank = sequences["20 frames without anything"].change(60, frame)
    assert not blank.color.any()
    assert not blank.depth_m.any()
    holes = sequences["half the depth missing"].change(5, frame)
    assert 0.35 < (holes.depth_m == 0).mean() < 0.65
    left = sequences["left half of the depth missing"].change(5, frame)
    assert (left.depth_m[:, :80] == 0).all()
    assert (left.depth_m[:, 80:] > 0).all()
    assert frame.depth_m.all(), "the frame itself is left alone"
    change = sequences["brightness x 0.5 to 1.6"].change
    means = [change(n, frame).color.mean() for n in range(100)]
    assert min(means) == pytest.approx(0.5 * frame.color.mean(), rel=0.02)
    assert max(means) > 1.3 * frame.color.mean()


def test_a_sequence_of_a_real_scan_is_measured() -> None:
    capture = str(data_folder() / "house" / "bedroom")
    figures = tracking_stress.measure_sequence(capture, "every 3rd frame")
    assert figures["ate_rmse_m"] < 0.01
    assert (figures["frames"], figures["with_pose"]) == (87, 87)
    assert figures["submaps"] == [[0, 86, 87]]
    _, header, _, line = tracking_stress.tabulate_stress([{"capture": "a", "sequence": "every 3rd frame", **figures}])
    assert header.count("|") == line.count("|")
    assert "87 of 87" in line


def test_what_could_not_be_measured_is_no_figure() -> None:
    rows = [
        {"capture": "a", "sequence": "full", "error": "it broke"},
        {"capture": "a", "sequence": "reversed", "ate_rmse_m": 0.01, "frames": 3, "with_pose": 2,
         "status": {"lost": 1, "tracked": 2}, "submaps": [[0, 2, 3]]},
    ]  # fmt: skip
    *_, broken, fine = tracking_stress.tabulate_stress(rows)
    assert "not available, it broke" in broken
    assert fine.split(" | ")[2:6] == ["1.00", "–", "2 of 3", "1"]


def test_lengths_that_could_not_be_measured_are_no_figures() -> None:
    one = {"frames": 250, "seconds": 5.0, "keyframes": 9, "bytes_per_keyframe": 2e5}
    *_, fine, broken = tracking_stress.tabulate_lengths(
        [{"capture": "a", **one}, {"capture": "b", "error": "no depth"}]
    )
    assert fine == "| a | 250 | 5.0 | 20.0 | 9 | 200 |"
    assert broken.startswith("| b | not available, no depth |")
