"""Queries by picture: the part that is used, and the regions that look like it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from manifests import tiny_manifest
from numpy.typing import NDArray
from small_captures import truncate
from worded_voxels import CUP, SOFA, box, feature, occupancy

from freeocc3d.core.errors import FreeOccError
from freeocc3d.language.encoders.color import ColorEncoder, ColorWords
from freeocc3d.language.feature_codec import Codec, CodedFeatures
from freeocc3d.query import image_query
from freeocc3d.query.word_query import Options
from freeocc3d.storage.manifest import EncoderRecord
from freeocc3d.storage.saved_map import SavedMap

ENCODER = ColorEncoder()


def picture(size: tuple[int, int] = (64, 48)) -> NDArray[np.uint8]:
    """Red on the left, blue on the right."""
    image = np.zeros((size[1], size[0], 3), np.uint8)
    image[:, : size[0] // 2] = 200, 20, 20
    image[:, size[0] // 2 :] = 20, 40, 200
    return image


def word(name: str) -> NDArray[np.float32]:
    return ColorWords().encode_words([name]).features[0]


def test_a_part_of_a_picture_is_what_it_shows() -> None:
    left = image_query.patch_feature(ENCODER, picture(), (0, 0, 27, 47))
    right = image_query.patch_feature(ENCODER, picture(), (36, 0, 63, 47))
    both = image_query.patch_feature(ENCODER, picture())
    for made in (left, right, both):
        assert np.linalg.norm(made) == pytest.approx(1, abs=1e-5)
    assert left @ word("red") > 0.6 > 0.1 > left @ word("blue")
    assert right @ word("blue") > 0.6 > 0.1 > right @ word("red")
    assert both @ word("blue") == pytest.approx(both @ word("red"), abs=0.15)
    one = image_query.patch_feature(ENCODER, picture(), (3, 5, 3, 5))
    assert one @ left > 0.99


def test_a_file_reads_as_its_pixels(tmp_path: Path) -> None:
    path = tmp_path / "p.png"
    cv2.imwrite(str(path), picture()[..., ::-1])
    np.testing.assert_array_equal(
        image_query.patch_feature(ENCODER, path, (0, 0, 9, 9)),
        image_query.patch_feature(ENCODER, picture(), (0, 0, 9, 9)),
    )
    truncate(path, 0.1)
    with pytest.raises(FreeOccError, match=r"p\.png is cut off"):
        image_query.patch_feature(ENCODER, path)
    with pytest.raises(FreeOccError, match=r"Cannot read .*: No such file"):
        image_query.patch_feature(ENCODER, tmp_path / "none.png")


@pytest.mark.parametrize("bad", [(5, 0, 4, 9), (0, 0, 64, 9), (-1, 0, 9, 9), (0, 48, 9, 48)])
def test_a_box_lies_in_the_picture(bad: tuple[int, int, int, int]) -> None:
    with pytest.raises(FreeOccError, match=r"does not lie in the picture\. Its pixels go from 0 0 to 63 47"):
        image_query.patch_feature(ENCODER, picture(), bad)


def test_what_is_no_picture_and_what_says_nothing() -> None:
    with pytest.raises(FreeOccError, match=r"got float64 \(3, 3, 3\)"):
        image_query.patch_feature(ENCODER, np.zeros((3, 3, 3)))  # type: ignore[arg-type]

    class Silent(ColorEncoder):
        def encode(self, frame: object) -> NDArray[np.float16]:
            return np.zeros((2, 2, 5), np.float16)

    with pytest.raises(FreeOccError, match="finds no feature in this part"):
        image_query.patch_feature(Silent(), picture())


def room(shared: float = 0.0) -> object:
    """A cup and a larger sofa, whose features have a share in common, as those of image networks do."""
    return occupancy(
        box((0, 0, 0), (3, 3, 3), feature(CUP=1, WALL=shared))
        | box((9, 0, 0), (15, 4, 4), feature(SOFA=1, WALL=shared))
        | box((30, 0, 0), (32, 2, 2), feature())
    )


@pytest.mark.parametrize("shared", [0.0, 3.0])
@pytest.mark.parametrize("coded", [False, True])
def test_what_looks_like_a_feature_is_found_whatever_all_have_in_common(shared: float, coded: bool) -> None:
    made = room(shared)
    if coded:
        codec = Codec.fit(made.features)
        made = made.replace(features=CodedFeatures(codec, codec.encode(made.features)))
    for name, voxels in ((CUP, 27), (SOFA, 96)):
        asked = np.asarray(made.features)[np.asarray(made.features)[:, name] > 0][0].astype(np.float32)
        result = image_query.query_feature(made, asked, "p.png")
        (region,) = result.regions
        assert region.voxels == voxels
        assert region.label == "p.png"
        assert region.confidence == pytest.approx(1, abs=0.01)
        f = np.asarray(made.features, np.float32)
        mean = f[f.any(axis=1)].mean(axis=0)
        expected = [(v - mean) @ (asked - mean) / np.linalg.norm(v - mean) / np.linalg.norm(asked - mean) for v in f]
        np.testing.assert_allclose(result.scores, np.where(f.any(axis=1), expected, 0), atol=0.02)


def test_what_the_map_does_not_hold_is_not_found() -> None:
    other = feature(DINING=1).astype(np.float32)
    result = image_query.query_feature(room(), other, "p.png")
    assert not result.matched
    assert result.note.startswith("Nothing in this map looks like p.png: the best score is")
    assert image_query.query_feature(occupancy({}), other, "p.png").note == "The map has no occupied voxels."
    with pytest.raises(FreeOccError, match="have 5 dimensions, those of pictures 7"):
        image_query.query_feature(room(), np.ones(7, np.float32), "p.png")
    with pytest.raises(FreeOccError, match="by cosines"):
        image_query.query_feature(room(), other, "p.png", Options(scores="softmax"))


def test_the_image_side_is_that_of_the_map_where_there_is_one(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("language: {encoder: colour, colour: {stride: 2}}\n", encoding="utf-8")
    files = {path.name: path.stat().st_size}
    assert image_query.picture_encoder(SavedMap(tmp_path, tiny_manifest(files=files))).options.stride == 2
    labels = tiny_manifest(files=files, encoder=EncoderRecord(name="labels", state={}))
    with pytest.raises(FreeOccError, match="'labels' reads more of the capture than its pictures"):
        image_query.picture_encoder(SavedMap(tmp_path, labels))
