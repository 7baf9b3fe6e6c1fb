"""Class images as features, the capture's own and those of a folder, and words for their classes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from small_captures import SIZE, class_image, write_image, write_replica, write_seven_scenes

from freeocc3d.capture import base, open_capture
from freeocc3d.capture.base import Capture
from freeocc3d.core.errors import CaptureError, ConfigError
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.language.encoders import labels
from freeocc3d.language.encoders.labels import LabelsEncoder, Options, load, load_text

NAMES = ["nothing", "sofa", "lamp"]


def opened(path: Path) -> Capture:
    return open_capture(path, base.Options(), {})


def scan(tmp_path: Path, n: int = 2) -> Capture:
    """A capture without class images."""
    return opened(write_seven_scenes(tmp_path / "scan", n))


def folder(tmp_path: Path, numbers: list[int], size: tuple[int, int] = SIZE, names: object = None) -> str:
    """Class images of another program, the n-th of them all of class n % 3, with a list of classes."""
    path = tmp_path / "masks"
    for n, number in enumerate(numbers):
        write_image(path / f"seg2_frame{number:05d}.png", np.full(size[::-1], n % 3, np.uint8))
    (path / "classes.json").write_text(json.dumps({"classes": names or NAMES}))
    return str(path)


def classes_of(features: NDArray[np.float16]) -> NDArray[np.int64]:
    return np.where(features.any(axis=2), features.argmax(axis=2) + 1, 0)


def test_features_of_the_captures_own_class_images(tmp_path: Path) -> None:
    capture = opened(write_replica(tmp_path / "room", 2, classes=True))
    encoder = load(Options(), capture)
    features = encoder.encode(capture[1])
    assert features.dtype == np.float16
    assert features.shape == (SIZE[1] // 2, SIZE[0] // 2, encoder.dimension)
    np.testing.assert_array_equal(classes_of(features), class_image()[::2, ::2])
    np.testing.assert_array_equal(np.linalg.norm(features, axis=2), 1)


@pytest.mark.parametrize("stride", [1, 3, 5])
def test_stride_covers_the_image_evenly(tmp_path: Path, stride: int) -> None:
    capture = opened(write_replica(tmp_path / "room", 1, classes=True))
    features = load(Options(stride=stride), capture).encode(capture[0])
    assert features.shape[:2] == (-(-SIZE[1] // stride), -(-SIZE[0] // stride))
    shares = [(classes_of(features) == k).mean() for k in (1, 2)]
    np.testing.assert_allclose(shares, 0.5, atol=0.5 / features.shape[1] + 1e-9)


def test_nothing_and_void_have_no_feature(tmp_path: Path) -> None:
    capture = scan(tmp_path)
    image = np.zeros(SIZE[::-1], np.uint8)
    image[:, :16] = 255
    assert not LabelsEncoder(tuple(NAMES), lambda index: image).encode(capture[0]).any()


def test_folder_with_an_image_for_each_frame_is_taken_in_order(tmp_path: Path) -> None:
    capture = scan(tmp_path, 3)
    encoder = load(Options(folder=folder(tmp_path, [100, 7, 105])), capture)
    assert [int(classes_of(encoder.encode(capture[i])).max()) for i in range(3)] == [1, 0, 2]


def test_folder_with_images_for_some_frames_goes_by_number(tmp_path: Path) -> None:
    capture = scan(tmp_path, 4)
    encoder = load(Options(folder=folder(tmp_path, [0, 3, 2])), capture)
    assert [int(classes_of(encoder.encode(capture[i])).max()) for i in range(4)] == [0, 0, 2, 1]
    assert encoder.encode(capture[1]).shape == (1, 1, 2)


def test_class_images_of_another_resolution_show_the_same(tmp_path: Path) -> None:
    capture = scan(tmp_path, 1)
    image = class_image((SIZE[0] * 2, SIZE[1] * 2))
    small, large = (
        LabelsEncoder(tuple(NAMES), lambda index, i=i: i).encode(capture[0]) for i in (class_image(), image)
    )
    np.testing.assert_array_equal(small, large)


def test_sixteen_bit_class_images_with_many_classes(tmp_path: Path) -> None:
    capture = scan(tmp_path, 1)
    path = tmp_path / "masks"
    write_image(path / "0.png", np.full(SIZE[::-1], 300, np.uint16))
    (path / "classes.txt").write_text("nothing\n" + "\n".join(f"thing {k}" for k in range(1, 400)) + "\n")
    encoder = load(Options(folder=str(path)), capture)
    assert encoder.dimension == 399
    assert (classes_of(encoder.encode(capture[0])) == 300).all()


def test_a_capture_without_class_images_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"language\.labels\.folder.*encoder=color"):
        load(Options(), scan(tmp_path))


@pytest.mark.parametrize(
    ("broken", "told"),
    [
        (lambda path: (path / "classes.json").unlink(), "no classes.json or classes.txt"),
        (lambda path: (path / "classes.json").write_text("{"), "must hold"),
        (lambda path: (path / "classes.json").write_text('{"names": []}'), "must hold"),
        (lambda path: (path / "classes.json").write_text('["nothing"]'), "at least 2"),
        (lambda path: (path / "classes.json").write_text('["nothing", 3]'), "a list of names"),
        (lambda path: [file.unlink() for file in path.glob("*.png")], "no class images"),
        (lambda path: (path / "other0.png").write_bytes((path / "seg2_frame00000.png").read_bytes()), "same number"),
    ],
)
def test_broken_folders_are_reported(tmp_path: Path, broken: object, told: str) -> None:
    path = folder(tmp_path, [0, 1])
    broken(Path(path))  # type: ignore[operator]
    with pytest.raises(CaptureError, match=told):
        load(Options(folder=path), scan(tmp_path))


def test_missing_classes_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"absent\.json"):
        load(Options(folder=folder(tmp_path, [0, 1]), classes=str(tmp_path / "absent.json")), scan(tmp_path))


def test_broken_class_images_are_reported(tmp_path: Path) -> None:
    capture = scan(tmp_path)
    path = Path(folder(tmp_path, [0, 1]))
    encoder = load(Options(folder=str(path)), capture)
    (path / "seg2_frame00000.png").write_bytes(b"not a picture")
    with pytest.raises(CaptureError, match="not a readable image"):
        encoder.encode(capture[0])
    (path / "seg2_frame00001.png").unlink()
    with pytest.raises(CaptureError, match="Cannot read"):
        encoder.encode(capture[1])


def test_another_aspect_ratio_and_values_without_names_are_reported(tmp_path: Path) -> None:
    capture = scan(tmp_path)
    for image, told in ((np.ones((20, 20), np.uint8), "20 x 20"), (np.full(SIZE[::-1], 9, np.uint8), "value 9")):
        with pytest.raises(CaptureError, match=told):
            LabelsEncoder(tuple(NAMES), lambda index, image=image: image).encode(capture[0])


def test_stride_out_of_range_is_refused() -> None:
    with pytest.raises(ConfigError):
        Options(stride=0)


def test_words_are_restored_from_plain_state(tmp_path: Path) -> None:
    capture = opened(write_replica(tmp_path / "room", 1, classes=True))
    words = load_text(json.loads(json.dumps(load(Options(), capture).text_state())))
    text = words.encode_words(["Couch", "the old lamp", "unicorn"])
    np.testing.assert_array_equal(text.features, [(1, 0), (0, 1), (0, 0)])
    assert text.understood == ("couch", "lamp", "")
    assert words.contrast_words() == ["sofa", "lamp"]


def test_a_word_for_several_classes_is_attained_by_each() -> None:
    words = load_text({"classes": ["nothing", "coffee table", "side table", "dining table", "sofa"]})
    text = words.encode_words(["table", "furniture"])
    np.testing.assert_allclose(np.linalg.norm(text.features, axis=1), 1, atol=1e-6)
    assert text.attainable is not None
    np.testing.assert_allclose(
        np.eye(4) @ text.features.T / text.attainable, [(1, 1), (1, 1), (1, 1), (0, 1)], atol=1e-6
    )


def test_the_note_names_classes() -> None:
    assert "sofa, lamp" in load_text({"classes": NAMES}).knows
    assert labels.LabelWords(["nothing", *map(str, range(50))]).knows.endswith("…)")


@pytest.mark.parametrize(("width", "fits"), [(1019, True), (981, True), (1021, False), (979, False)])
def test_class_images_have_the_frames_shape_up_to_two_percent(width: int, fits: bool) -> None:
    frame = Frame(
        0,
        0.0,
        np.zeros((50, 100, 3), np.uint8),
        np.zeros((50, 100), np.float32),
        Intrinsics(100, 50, 90.0, 90.0, 49.5, 24.5),
    )
    encoder = labels.LabelsEncoder(("nothing", "cup"), lambda index: np.ones((500, width), np.uint8), 10)
    if fits:
        assert encoder.encode(frame).shape[:2] == (5, 10)
    else:
        with pytest.raises(CaptureError, match="Their views differ"):
            encoder.encode(frame)
