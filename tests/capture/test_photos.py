from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageFile, ImageOps
from small_captures import (
    color_image,
    depth_image,
    truncate,
    write_image,
    write_replica,
    write_scannet,
    write_seven_scenes,
)

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.cameras.camera_files import DIAGONAL_35MM, USUAL_FOCAL
from freeocc3d.capture.images.heif_files import register_heif
from freeocc3d.capture.readers.photos import apply_orientation, list_images
from freeocc3d.core.errors import CaptureError, FrameError

SIZE = 64, 48


def write_photo(
    path: Path,
    index: int = 0,
    size: tuple[int, int] = SIZE,
    orientation: int | None = None,
    exif: dict[int, object] | None = None,
) -> Path:
    """exif: tags of the Exif part. The image is stored as it is given, whatever the orientation says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    if orientation is not None:
        tags[0x0112] = orientation
    tags.get_ifd(0x8769).update(exif or {})
    Image.fromarray(color_image(index, size)).save(path, exif=tags, quality=95)
    return path


def write_photos(folder: Path, count: int = 4, **kinds: object) -> Path:
    for index in range(count):
        write_photo(folder / f"IMG_{index + 8}.jpg", index, **kinds)  # type: ignore[arg-type]
    return folder


def test_opening_decodes_no_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow decodes a PNG to look for EXIF data behind the pixels."""
    for index, suffix in enumerate(("png", "jpg", "tif", "webp", "png")):
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray(color_image(index, SIZE)).save(tmp_path / f"{index}.{suffix}", exif=exif)
    write_image(tmp_path / "5.png", color_image(5, SIZE[::-1]))
    decoded: list[ImageFile.ImageFile] = []
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda image: decoded.append(image))
    capture = open_capture(tmp_path)
    assert (len(capture), capture[0].color.shape, decoded) == (6, (64, 48, 3), [])


def test_images_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    write_photos(tmp_path, 4)
    (tmp_path / "notes.txt").write_text("where and when")
    (tmp_path / "._IMG_8.jpg").write_bytes(b"")
    capture = open_capture(tmp_path)
    assert capture.format == "photos"
    assert [capture.name(index) for index in range(4)] == ["IMG_8.jpg", "IMG_9.jpg", "IMG_10.jpg", "IMG_11.jpg"]
    frame = capture[2]
    assert np.abs(frame.color.astype(int) - color_image(2, SIZE)).mean() < 3
    assert (frame.index, frame.timestamp) == (2, 2.0)
    assert not frame.depth_m.any()
    assert not capture.has_depth
    assert not capture.intrinsics_known
    assert not capture.focal_stated
    assert frame.intrinsics.fx == pytest.approx(USUAL_FOCAL * 64)


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif", "webp"])
def test_other_kinds_of_images_and_a_folder_called_images(tmp_path: Path, suffix: str) -> None:
    for index in range(3):
        write_image(tmp_path / "images" / f"{index}.{suffix}", color_image(index, SIZE))
    capture = open_capture(tmp_path)
    assert capture.format == "photos"
    assert np.abs(capture[1].color.astype(int) - color_image(1, SIZE)).mean() < 6


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_orientation_of_exif_is_applied(tmp_path: Path, orientation: int) -> None:
    write_photos(tmp_path, 2, orientation=orientation)
    frame = open_capture(tmp_path)[1]
    with Image.open(tmp_path / "IMG_9.jpg") as image:
        expected = np.asarray(ImageOps.exif_transpose(image))
    np.testing.assert_allclose(frame.color.astype(int), expected.astype(int), atol=4)
    np.testing.assert_array_equal(apply_orientation(color_image(1, SIZE), 1), color_image(1, SIZE))
    assert (frame.intrinsics.width, frame.intrinsics.height) == expected.shape[1::-1]
    assert frame.intrinsics.cx == (expected.shape[1] - 1) / 2


def test_large_images_are_reduced_with_their_camera(tmp_path: Path) -> None:
    write_photos(tmp_path, 2)
    given = (60.0, 61.0, 30.0, 22.0)
    whole = open_capture(tmp_path, Options(intrinsics=given))[1]
    capture = open_capture(tmp_path, Options(intrinsics=given, max_size=32))
    assert capture.intrinsics_known
    assert capture[1].intrinsics == whole.intrinsics.resized(32, 24)
    np.testing.assert_array_equal(capture[1].color, cv2.resize(whole.color, (32, 24), interpolation=cv2.INTER_AREA))


@pytest.mark.parametrize(
    ("exif", "focal"),
    [
        ({0xA405: 28}, 28 / DIAGONAL_35MM * 80),
        # 4 mm, 20 pixels a mm of an image of 128 pixels, of which half are left.
        ({0x920A: 4.0, 0xA20E: 20.0, 0xA210: 4, 0xA002: 128}, 4 * 20 / 2),
        ({0x920A: 4.0, 0xA20E: 254.0, 0xA210: 2}, 40.0),
    ],
)
def test_the_focal_length_of_exif_is_a_prior(tmp_path: Path, exif: dict[int, object], focal: float) -> None:
    capture = open_capture(write_photos(tmp_path, 3, exif=exif))
    assert capture.focal_stated
    assert not capture.intrinsics_known
    assert capture[0].intrinsics.fx == pytest.approx(focal, rel=1e-4)


def test_a_zoom_and_nonsense_are_no_prior(tmp_path: Path) -> None:
    write_photos(tmp_path / "zoom", 4, exif={0xA405: 28})
    write_photo(tmp_path / "zoom" / "IMG_8.jpg", exif={0xA405: 70})
    assert not open_capture(tmp_path / "zoom").focal_stated
    write_photos(tmp_path / "odd", 3, exif={0x920A: 4.0, 0xA20E: 0.1, 0xA210: 2})
    assert not open_capture(tmp_path / "odd").focal_stated


def test_times_are_those_of_exif_if_they_ascend(tmp_path: Path) -> None:
    for index, (time, part) in enumerate([("10:00:00", "25"), ("10:00:00", "750"), ("10:00:03", "")]):
        exif = {0x9003: f"2026:03:01 {time}", 0x9291: part}
        write_photo(tmp_path / f"{index}.jpg", index, exif=exif)
    np.testing.assert_allclose(open_capture(tmp_path).timestamps, [0.0, 0.5, 2.75])
    write_photo(tmp_path / "3.jpg", exif={0x9003: "2026:03:01 09:00:00"})
    np.testing.assert_allclose(open_capture(tmp_path).timestamps, [0, 1, 2, 3])


@pytest.mark.parametrize(("most", "least"), [(1, 6), (1, 8), (6, 1), (6, 3)])
def test_what_one_camera_took_held_the_other_way_is_turned_to_the_size_of_most(
    tmp_path: Path, most: int, least: int
) -> None:
    write_photos(tmp_path, 4, orientation=most, exif={0xA405: 28})
    write_photo(tmp_path / "IMG_9.jpg", 1, orientation=least, exif={0xA405: 28})
    capture = open_capture(tmp_path)
    assert capture.warnings == ()
    assert capture.focal_stated
    assert [capture.turned(index) for index in (0, 2, 3)] == [0, 0, 0]
    # Pixels lie on the sensor as those of the other images do, so that all have one principal point and lens.
    stored = color_image(1, SIZE).astype(int)
    expected = np.rot90(stored, -1) if most == 6 else stored
    assert np.abs(capture[1].color - expected).mean() < 4
    assert capture[1].color.flags.c_contiguous
    assert {capture[index].intrinsics for index in range(4)} == {capture[1].intrinsics}
    with Image.open(tmp_path / "IMG_9.jpg") as image:
        held = np.asarray(ImageOps.exif_transpose(image)).astype(int)
    np.testing.assert_allclose(np.rot90(held, capture.turned(1)), capture[1].color, atol=4)


def test_photographs_without_exif_are_turned_as_well(tmp_path: Path) -> None:
    write_photos(tmp_path, 3)
    write_photo(tmp_path / "IMG_9.jpg", 1, size=(48, 64))
    capture = open_capture(tmp_path)
    assert capture.turned(1) == 1
    assert np.abs(capture[1].color - np.rot90(color_image(1, (48, 64)).astype(int))).mean() < 4


def test_images_of_other_sizes_are_left_out_with_a_warning(tmp_path: Path) -> None:
    write_photos(tmp_path, 6)
    write_photo(tmp_path / "IMG_10.jpg", size=(48, 64))
    write_photo(tmp_path / "IMG_11.jpg", size=(80, 60))
    (tmp_path / "IMG_12.jpg").write_text("no image")
    capture = open_capture(tmp_path)
    assert [capture.name(index) for index in range(len(capture))] == [f"IMG_{n}.jpg" for n in (8, 9, 10, 12, 13)]
    (warning,) = capture.warnings
    assert warning.code == "images-left-out"
    assert "1 of the 6 images" in warning.text
    assert "is left out, first IMG_11.jpg with 80 x 60 pixels: the others have 64 x 48" in warning.text
    assert capture[2].color.shape == (48, 64, 3)
    with pytest.raises(FrameError, match=r"IMG_12\.jpg is not a readable image"):
        capture[3]
    write_photo(tmp_path / "IMG_13.jpg", size=(80, 60))
    assert "2 of the 6 images" in open_capture(tmp_path).warnings[0].text


def test_images_of_which_no_two_have_one_size_are_refused(tmp_path: Path) -> None:
    for index in range(3):
        write_photo(tmp_path / f"{index}.jpg", size=(64, 48 + 2 * index))
    with pytest.raises(CaptureError, match=r"The 3 images of .* all have different sizes, but a scan needs one camera"):
        open_capture(tmp_path)


def test_damaged_images_are_broken_frames(tmp_path: Path) -> None:
    write_photos(tmp_path, 4)
    (tmp_path / "IMG_9.jpg").write_text("no image")
    truncate(tmp_path / "IMG_10.jpg")
    capture = open_capture(tmp_path)
    with pytest.raises(FrameError, match=r"IMG_9\.jpg is not a readable image"):
        capture[1]
    with pytest.raises(FrameError, match=r"IMG_10\.jpg is cut off"):
        capture[2]
    for path in list_images(tmp_path):
        path.write_text("no image")
    with pytest.raises(CaptureError, match=r"No image of .* can be read"):
        open_capture(tmp_path)


def test_too_few_and_what_phones_write_are_reported(tmp_path: Path) -> None:
    write_photo(tmp_path / "one" / "IMG_1.jpg")
    with pytest.raises(CaptureError, match=r"holds only one image, IMG_1\.jpg: a scan needs many"):
        open_capture(tmp_path / "one")
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone" / "IMG_1.HEIC").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"IMG_1\.HEIC and similar files, which cannot be decoded: convert them"):
        open_capture(tmp_path / "phone")


@pytest.mark.parametrize("write", [write_seven_scenes, write_replica, write_scannet])
def test_folders_of_other_formats_stay_theirs(tmp_path: Path, write) -> None:
    write(tmp_path, 2)
    assert open_capture(tmp_path).format == write.__name__.removeprefix("write_")


def test_a_folder_with_depth_images_among_others_is_not_taken_for_photographs(tmp_path: Path) -> None:
    write_image(tmp_path / "frame000000.png", color_image(0))
    write_image(tmp_path / "depth000000.png", depth_image(0))
    assert open_capture(tmp_path).format == "image_folders"


def write_heif(path: Path, index: int, orientation: int = 1, kind: str = "HEIF", time: str = "", **more) -> Path:
    """A photograph as phones store it: the stored image of a camera that is turned, with the file's own turn."""
    register_heif()
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update({0xA405: 28, **({0x9003: time} if time else {})})
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(color_image(index, SIZE))
    image.save(path, kind, exif=exif.tobytes(), quality=95, **more)
    return path


@pytest.mark.parametrize("kind", ["HEIF", "AVIF"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_heif_images_are_turned_once_also_among_others(tmp_path: Path, kind: str, orientation: int) -> None:
    for index in range(3):
        write_photo(tmp_path / f"IMG_{index}.jpg", index, orientation=orientation)
    for index in range(3, 6):
        path = write_heif(tmp_path / f"IMG_{index}.{kind}", index, orientation, kind)
        if kind == "HEIF":
            assert (b"irot" in path.read_bytes()) == (orientation != 1)
    path.rename(tmp_path / "IMG_5.JPG")  # as some programs name it
    capture = open_capture(tmp_path)
    assert (len(capture), capture.warnings) == (6, ())
    for index in (0, 4, 5):
        expected = apply_orientation(color_image(index, SIZE), orientation)
        assert capture[index].color.shape == expected.shape
        assert np.abs(capture[index].color.astype(int) - expected).mean() < 4


def test_heif_images_state_lens_and_time_and_are_turned_to_the_size_of_most(tmp_path: Path) -> None:
    for index in range(4):
        time = f"2024:05:01 10:00:0{index}"
        write_heif(tmp_path / f"IMG_{index}.HEIC", index, 1 if index < 3 else 6, time=time)
    capture = open_capture(tmp_path)
    np.testing.assert_array_equal(capture.timestamps, np.arange(4))
    assert capture.focal_stated
    assert capture.intrinsics.fx == pytest.approx(28 / DIAGONAL_35MM * np.hypot(*SIZE))
    assert (capture.turned(0), capture.turned(3)) == (0, 1)
    assert np.abs(capture[3].color.astype(int) - color_image(3, SIZE)).mean() < 4


def test_images_that_cannot_be_decoded_are_counted_and_left_out(tmp_path: Path) -> None:
    write_photos(tmp_path, 7)
    for index in range(20, 33):
        (tmp_path / f"IMG_{index}.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(2000))
    (tmp_path / "IMG_40.DNG").write_bytes(b"II*\0" + bytes(100))
    (tmp_path / "IMG_8.DNG").write_bytes(b"II*\0" + bytes(100))  # beside its JPEG
    capture = open_capture(tmp_path)
    assert len(capture) == 7
    dng, heic = (notice.text for notice in capture.warnings)
    assert dng.startswith("1 .dng (DNG) of 21 images")
    assert heic.startswith("13 .heic (HEIC) of 21 images")
    assert "first IMG_20.HEIC" in heic
    for index in range(7):
        (tmp_path / f"IMG_{index + 8}.jpg").unlink()
    with pytest.raises(CaptureError, match="similar files, which cannot be decoded: convert them to JPEG"):
        open_capture(tmp_path)


def test_a_heic_image_beside_its_jpeg_is_left_out(tmp_path: Path) -> None:
    write_photos(tmp_path, 3)
    write_heif(tmp_path / "IMG_9.HEIC", 1)
    capture = open_capture(tmp_path)
    assert [capture.name(index) for index in range(len(capture))] == ["IMG_8.jpg", "IMG_9.jpg", "IMG_10.jpg"]
    assert "1 .heic (HEIC) of 4 images" in capture.warnings[0].text


@pytest.mark.parametrize("share", [0.3, 0.7, 0.98])
def test_a_heif_image_that_is_cut_off_later_is_a_broken_frame(tmp_path: Path, share: float) -> None:
    for index in range(3):
        write_heif(tmp_path / f"IMG_{index}.heic", index)
    capture = open_capture(tmp_path)
    truncate(tmp_path / "IMG_1.heic", share)
    with pytest.raises(FrameError, match=r"IMG_1\.heic is not a readable image"):
        capture[1]
    (tmp_path / "IMG_1.heic").unlink()
    with pytest.raises(FrameError, match=r"IMG_1\.heic is not a readable image"):
        capture[1]
    assert capture[2].color.shape == (48, 64, 3)
