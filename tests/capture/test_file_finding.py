import os
import time
from pathlib import Path

import pytest

from freeocc3d.capture.files.file_finding import FileFinder, report_missing
from freeocc3d.core.errors import CaptureError


def make(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    return folder


@pytest.mark.parametrize(
    ("stated", "there"),
    [
        ("images/a 1.jpg", "images/a 1.jpg"),
        ("./images/a.jpg", "images/a.jpg"),
        (r"images\a.jpg", "images/a.jpg"),
        (r".\images\a.jpg", "images/a.jpg"),
        (r"C:\Users\me\scan\images\a.jpg", "images/a.jpg"),
        ("/home/me/scan/images/a.jpg", "images/a.jpg"),
        ("../scan/images/a.jpg", "images/a.jpg"),
        ("images/A.JPG", "images/a.jpg"),
        ("Images/A.JPG", "images/a.jpg"),
        ("images/a.png", "images/a.jpg"),
        ("images/a", "images/a.jpg"),
        ("images/1.5", "images/1.5.png"),
        ("a.jpg", "images/a.jpg"),
        ("/elsewhere/frames/a.jpg", "images/a.jpg"),
        (r"images\a.jpg", r"images\a.jpg"),
        ("caf\u0065\u0301.jpg", "caf\u00e9.jpg"),
    ],
)
def test_a_stated_name_is_found(tmp_path, stated, there):
    make(tmp_path, there, "images/b.jpg", "images/other.txt")
    assert FileFinder(tmp_path, "color").find(stated) == tmp_path / there


@pytest.mark.parametrize(
    "stated", ["images/c.jpg", "../secret.jpg", "/etc/passwd", "", "..", "images", "a\0b.jpg", "images/x.txt", "/"]
)
def test_what_is_not_there_is_not_found(tmp_path, stated):
    make(tmp_path, "secret.jpg", "scan/images/a.jpg", "scan/depth/c.jpg", "scan/images/x.jpg.txt")
    assert FileFinder(tmp_path / "scan", "color").find(stated) is None


def test_a_file_of_another_kind_or_folder_is_not_taken(tmp_path):
    make(tmp_path, "images/a.jpg", "depth/b.png", "masks/c.png", "images_2/d.jpg")
    color, depth = FileFinder(tmp_path, "color"), FileFinder(tmp_path, "depth")
    assert color.find("b.png") is None  # that is depth
    assert color.find("c.png") is None  # that is a mask
    assert color.find("images/d.jpg") is None  # images/ is here, and lacks it
    assert depth.find("frames/b.png") == tmp_path / "depth/b.png"
    assert depth.find("frames/a.png") is None


def test_ambiguous_names_are_not_found(tmp_path):
    make(tmp_path, "one/a.jpg", "two/a.jpg", "images/b.jpg", "images/b.webp", "images/c.JPG", "images/C.jpg")
    finder = FileFinder(tmp_path, "color")
    assert [finder.find(name) for name in ("a.jpg", "images/b.tif", "images/c.jpg")] == [None] * 3
    make(tmp_path, "images/b.png")
    assert FileFinder(tmp_path, "color").find("images/b") == tmp_path / "images/b.png"


def test_several_names_do_not_share_a_file_that_is_not_their_path(tmp_path):
    make(tmp_path, "a.jpg", "b.jpg")
    found = FileFinder(tmp_path, "color").find_all(["cam0/a.jpg", "cam1/a.jpg", "b.jpg", "./b.jpg", "B.JPG"])
    assert found == [None, None, tmp_path / "b.jpg", tmp_path / "b.jpg", None]


def test_links_lead_into_no_loop(tmp_path):
    make(tmp_path, "images/a.jpg")
    os.symlink("..", tmp_path / "images" / "up")
    os.symlink("self", tmp_path / "self")
    finder = FileFinder(tmp_path, "color")
    assert finder.find("z/a.jpg") == tmp_path / "images/a.jpg"
    assert finder.find("z/b.jpg") is None


def test_ten_thousand_names_are_found_in_no_time(tmp_path):
    names = [f"images/{number:06d}.jpg" for number in range(10_000)]
    make(tmp_path, *names)
    start = time.process_time()
    foreign = ["D:\\scan\\" + name.replace("/", "\\") for name in names]
    assert FileFinder(tmp_path, "color").find_all(foreign) == [tmp_path / name for name in names]
    assert time.process_time() - start < 2


def test_missing_files_are_counted_and_the_first_is_named(tmp_path):
    make(tmp_path, "images/IMG_0000.jpg", "images/IMG_0001.jpg")
    finder = FileFinder(tmp_path / "images", "color")
    names = ["IMG_0000.JPG", "IMG_0001.JPG", "IMG_7.JPG", "IMG_8.JPG"]
    (notice,) = report_missing(names, finder.find_all(names), finder, "the model")
    assert notice.code == "images-left-out"
    assert "2 of the 4 images that the model names are not in images/" in notice.text
    assert "the first is IMG_7.JPG (there is IMG_0001.jpg)" in notice.text
    assert report_missing(names[:2], finder.find_all(names[:2]), finder, "the model") == ()
    with pytest.raises(CaptureError, match=r"None of the 2 images that the model names is in images/.*IMG_7.JPG \(th"):
        report_missing(names[2:], finder.find_all(names[2:]), finder, "the model")
    with pytest.raises(CaptureError, match="Only one of the 2 images"):
        report_missing(names[1:3], finder.find_all(names[1:3]), finder, "the model")
    empty = FileFinder(tmp_path / "nowhere", "color")
    with pytest.raises(CaptureError, match="holds no files"):
        report_missing(names, empty.find_all(names), empty, "the model")
