"""Class images: of a capture, of a folder; words that mean classes."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import SIZE, class_image, write_replica, write_seven_scenes
from scenes import wall_frame

from freeocc3d.capture import open_capture
from freeocc3d.errors import CaptureError
from freeocc3d.language.encoders import labels

CLASSES = ["nothing", "sofa", "coffee table", "dining table", "television", "trash can"]


def test_the_captures_class_images_become_unit_vectors(tmp_path) -> None:
    capture = open_capture(write_replica(tmp_path / "scan", 2, classes=True))
    encoder = labels.load(labels.Options(), capture)
    features = encoder.encode(capture[0])
    assert features.shape == (SIZE[1] // 2, SIZE[0] // 2, 2)
    np.testing.assert_array_equal(features[:, : SIZE[0] // 4], np.broadcast_to([1, 0], (SIZE[1] // 2, SIZE[0] // 4, 2)))
    np.testing.assert_array_equal(features[:, SIZE[0] // 4 :], np.broadcast_to([0, 1], (SIZE[1] // 2, SIZE[0] // 4, 2)))
    assert labels.load_text(encoder.text_state()).contrast_words() == ["sofa", "lamp"]


def write_folder(folder: Path, numbers, names) -> labels.Options:
    folder.mkdir()
    for n in numbers:
        cv2.imwrite(str(folder / f"pred_{n}.png"), class_image())
    (folder / "names.txt").write_text("\n".join(names))
    return labels.Options(folder=str(folder), classes=str(folder / "names.txt"))


def test_another_programs_images_are_found_by_number_and_gaps_say_nothing(tmp_path) -> None:
    capture = open_capture(write_seven_scenes(tmp_path / "scan", 3))
    encoder = labels.load(write_folder(tmp_path / "pred", (0, 2), ["nothing", "cup", "door"]), capture)
    assert encoder.encode(capture[0]).any()
    assert not encoder.encode(capture[1]).any()
    assert encoder.encode(capture[2])[0, 0].argmax() == 0


def test_missing_class_images_and_names_are_told(tmp_path) -> None:
    capture = open_capture(write_seven_scenes(tmp_path / "scan", 2))
    with pytest.raises(CaptureError, match=r"language\.labels\.folder"):
        labels.load(labels.Options(), capture)
    with pytest.raises(CaptureError, match="classes"):
        labels.load(labels.Options(folder=str(tmp_path)), capture)
    (tmp_path / "names.json").write_text(json.dumps({"classes": ["nothing", "cup"]}))
    with pytest.raises(CaptureError, match="no class images"):
        labels.load(labels.Options(folder=str(tmp_path / "no"), classes=str(tmp_path / "names.json")), capture)
    with pytest.raises(CaptureError, match="class names"):
        labels.load(labels.Options(folder=str(tmp_path), classes=str(tmp_path / "absent.json")), capture)


def test_a_value_without_a_name_is_told(tmp_path) -> None:
    options = write_folder(tmp_path / "pred", (0,), ["nothing", "cup"])  # the images hold 1 and 2
    encoder = labels.load(options, open_capture(write_seven_scenes(tmp_path / "scan", 1)))
    with pytest.raises(CaptureError, match="value 2"):
        encoder.encode(wall_frame(2.0))


@pytest.mark.parametrize(
    ("word", "classes", "understood"),
    [
        ("sofa", {"sofa"}, "sofa"), ("Couches", {"sofa"}, "couch"), ("the red sofa", {"sofa"}, "sofa"),
        ("table", {"coffee table", "dining table"}, "table"), ("coffee table", {"coffee table"}, "coffee table"),
        ("TV", {"television"}, "tv"), ("rubbish", set(), ""), ("bin", {"trash can"}, "bin"), ("bathtub", set(), ""),
        ("sofa table", {"coffee table", "dining table"}, "table"), ("", set(), ""),
    ],
)  # fmt: skip
def test_words_reach_classes_by_name_synonym_and_kind(word, classes, understood) -> None:
    text = labels.load_text({"classes": CLASSES}).encode_words([word])
    assert text.understood == (understood,)
    assert {CLASSES[1 + k] for k in np.flatnonzero(text.features[0])} == classes
    assert np.linalg.norm(text.features[0]) == pytest.approx(1.0 if classes else 0.0, abs=1e-6)
