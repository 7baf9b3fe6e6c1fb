"""What is said of a folder that is no capture: what lies there, and never a pointer to depth alone."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from posed_captures import write_colmap, write_nerfstudio
from small_captures import color_image, depth_image, write_image, write_scannet, write_seven_scenes

from freeocc3d.capture import Options, open_capture
from freeocc3d.capture.folder_contents import find_image_folders, holds_depth_or_confidence
from freeocc3d.capture.recognition import list_readers
from freeocc3d.core.errors import CaptureError, DependencyError
from freeocc3d.settings import registry


def write_images(folder: Path, kind: str, count: int = 3, suffix: str = "png") -> Path:
    for index in range(count):
        image = {
            "color": color_image(index),
            "depth": depth_image(index),
            "confidence": np.full((24, 32), index % 3, np.uint8),
        }[kind]
        write_image(folder / f"{index}.{suffix}", image)
    return folder


def said_of(path: Path) -> str:
    with pytest.raises(CaptureError) as caught:
        open_capture(path)
    return str(caught.value)


@pytest.mark.parametrize("kind", ["color", "depth", "confidence"])
def test_the_kind_of_a_folder_is_told_by_the_head_of_a_file(tmp_path: Path, kind: str) -> None:
    folder = write_images(tmp_path / ("conf" if kind == "confidence" else "a"), kind)
    (found,) = find_image_folders(tmp_path)
    assert (found.path, found.kind, found.count, found.suffix, found.size) == (folder, kind, 3, ".png", (32, 24))
    assert holds_depth_or_confidence(folder) == (None if kind == "color" else kind)


@pytest.mark.parametrize("suffix", ["exr", "npy", "pgm", "tiff"])
def test_depth_of_other_suffixes_is_depth(tmp_path: Path, suffix: str) -> None:
    for index in range(2):
        path = tmp_path / "depth" / f"{index}.{suffix}"
        path.parent.mkdir(exist_ok=True)
        if suffix == "tiff":
            cv2.imwrite(str(path), depth_image(index).astype(np.float32))
        else:
            path.write_bytes(b"")
    assert holds_depth_or_confidence(tmp_path / "depth") == "depth"


@pytest.mark.parametrize("kind", ["depth", "confidence"])
def test_a_folder_of_depth_or_confidence_is_never_a_set_of_photographs(tmp_path: Path, kind: str) -> None:
    folder = write_images(tmp_path / kind, kind)
    assert f"it holds {kind} images alone. Give the folder that holds both" in said_of(folder)
    assert "give that folder" not in said_of(tmp_path)


def test_color_beside_depth_under_odd_names_is_named_with_a_likely_reading(tmp_path: Path) -> None:
    write_images(tmp_path / "front", "color")
    write_images(tmp_path / "range", "depth")
    said = said_of(tmp_path)
    assert "color in front/ (3 .png of 32 x 24)" in said
    assert "depth in range/ (3 .png of 32 x 24)" in said
    assert f"link them as {tmp_path / 'color'} and {tmp_path / 'depth'}" in said
    assert "give that folder" not in said


def test_the_nearest_formats_say_what_they_lack(tmp_path: Path) -> None:
    write_images(tmp_path / "keyframes" / "images", "color")
    write_images(tmp_path / "keyframes" / "d", "depth")
    said = said_of(tmp_path)
    assert "The nearest formats: polycam lacks keyframes/depth and keyframes/cameras" in said


def test_the_folder_above_several_captures_names_the_first_and_counts_them(tmp_path: Path) -> None:
    for name in ("seq-01", "seq-02"):
        write_seven_scenes(tmp_path / name, 2)
    assert f"but {tmp_path / 'seq-01'} is (and 1 more): give that folder" in said_of(tmp_path)


@pytest.mark.parametrize("write", [write_colmap, lambda folder, count: write_nerfstudio(folder, count, depth=False)])
def test_depth_beside_a_reconstruction_is_not_left_out_in_silence(tmp_path: Path, write) -> None:
    write(tmp_path, 3)
    assert not [notice for notice in open_capture(tmp_path).warnings if notice.code == "depth-not-read"]
    write_images(tmp_path / "depth", "depth")
    capture = open_capture(tmp_path)
    (notice,) = (notice for notice in capture.warnings if notice.code == "depth-not-read")
    assert f"{tmp_path / 'depth'} holds 3 depth images" in notice.text
    assert open_capture(tmp_path, Options(format="image_folders")).has_depth


@pytest.mark.parametrize(
    ("name", "head", "said"),
    [
        ("scan.zip", b"PK\x03\x04 and more", "is an archive: unpack it"),
        ("scan.tar.gz", b"\x1f\x8b\x08 and more", "is an archive: unpack it"),
        ("room.ply", b"ply\nformat ascii 1.0\n", "is a mesh or a point cloud"),
        ("a.png", b"\x89PNG\r\n\x1a\n", "is a single image: give the folder"),
    ],
)
def test_a_file_that_is_no_recording_is_called_what_it_is(tmp_path: Path, name: str, head: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(head)
    assert said in said_of(tmp_path / name)


def test_a_folder_without_images_says_what_it_holds_and_what_a_capture_is(tmp_path: Path) -> None:
    assert "it is empty. A capture is a folder with images, such as color/ and depth/" in said_of(tmp_path)
    for index in range(3):
        (tmp_path / f"note_{index}.md").touch()
    said = said_of(tmp_path)
    assert "holds note_0.md and 2 others, but neither images nor a video" in said
    assert len(said) < 400


def test_every_layout_of_depth_images_is_read_whatever_their_suffix(tmp_path: Path) -> None:
    write_scannet(tmp_path, 2)
    for index in range(2):
        (tmp_path / "depth" / f"{index}.png").unlink()
        cv2.imwrite(str(tmp_path / "depth" / f"{index}.tiff"), depth_image(index).astype(np.float32) / 1000)
    capture = open_capture(tmp_path)
    assert capture.format == "scannet"
    assert np.isclose(capture[1].depth_m.max(), 2.01)


def test_a_format_whose_package_is_missing_is_recognized_and_names_the_extra(tmp_path: Path, monkeypatch) -> None:
    assert "ros_bag" in list_readers()
    (tmp_path / "walk.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    monkeypatch.setattr(registry.Backend, "missing", property(lambda backend: backend.requires))
    monkeypatch.setattr(registry, "_extra", lambda package: "ros" if package == "rosbags" else "")
    with pytest.raises(DependencyError, match=r"needs rosbags: run pip install 'freeocc3d\[ros\]'"):
        open_capture(tmp_path / "walk.bag", Options())


def test_the_extra_of_a_package_is_read_from_what_is_installed() -> None:
    assert registry._extra("rosbags") in ("ros", "")
    assert registry._extra("no_such_package") == ""


def test_the_color_folder_of_a_capture_with_depth_is_told_to_be_one(tmp_path: Path, monkeypatch) -> None:
    write_scannet(tmp_path / "scan", 3)
    color = tmp_path / "scan" / "color"
    monkeypatch.chdir(color)
    for given in (color, Path(".")):
        (notice,) = open_capture(given).warnings
        assert notice.code == "depth-not-read"
        assert f"give {tmp_path / 'scan'} to use both" in notice.text
    assert open_capture(color, Options(depth=False)).warnings == ()
    shutil.rmtree(tmp_path / "scan" / "depth")
    assert open_capture(color).warnings == ()
