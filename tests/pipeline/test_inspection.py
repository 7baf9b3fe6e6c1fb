"""What is said of a capture before a run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from PIL import Image
from pipeline_runs import notices
from posed_captures import write_nerfstudio
from small_captures import color_image, data_folder, depth_image, write_image, write_scannet

from freeocc3d import reconstruct
from freeocc3d.core.errors import CaptureError
from freeocc3d.pipeline.inspection import inspect
from freeocc3d.settings import config


def test_a_sound_capture_has_nothing_to_fix() -> None:
    room = {"synthetic": {"frames": 120, "width": 160, "height": 120}}
    found = inspect("builtin:room", config.resolve({"capture": room}))
    assert (found.format, found.frames, found.size, found.frame_size) == ("synthetic", 120, (160, 120), (160, 120))
    assert found.notices == ()
    assert found.problems == ()
    assert found.poses == 1
    assert found.depth is not None
    assert 1 < found.depth.median_m < 4
    assert found.depth.coverage > 0.8
    assert found.tracking.startswith("Tracking with rgbd: the capture has depth")


def test_the_kitchens_color_camera_is_found_and_nothing_else() -> None:
    found = inspect(data_folder() / "7scenes-kitchen")
    assert [notice.code for notice in found.notices] == ["color-focal-corrected"]
    assert found.camera == "stated, focal length 585 px"
    assert found.rate is None


def test_what_is_wrong_is_told_frame_by_frame(tmp_path: Path) -> None:
    write_scannet(tmp_path, 4)
    for path in (tmp_path / "intrinsic").iterdir():
        path.unlink()
    (tmp_path / "color" / "2.png").write_bytes(b"no image")
    for index in (0, 1, 3):
        write_image(tmp_path / "color" / f"{index}.png", color_image(index) // 16)
    found = inspect(tmp_path)
    assert found.camera == "not stated"
    assert [notice.code for notice in found.notices] == ["images-unreadable", "intrinsics-unknown", "images-dark"]
    assert "give --focal" in found.notices[1].text
    (broken,) = found.problems
    assert "color/2.png" in broken
    assert found.notices[2].text.startswith("3 of 3 color images")


def test_the_rough_focal_length_of_exif_data_is_used_if_the_scan_shows_none(tmp_path: Path) -> None:
    for index in range(4):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA405] = 26  # 35 mm equivalent
        (tmp_path / "rgb").mkdir(exist_ok=True)
        Image.fromarray(color_image(index)).save(tmp_path / "rgb" / f"{index}.jpg", exif=exif)
        write_image(tmp_path / "depth" / f"{index}.png", depth_image(index))
    found = inspect(tmp_path)
    assert found.camera == "roughly stated, focal length 24 px"
    assert "the rough value of the images" in next(n.text for n in found.notices if n.code == "intrinsics-unknown")
    made = reconstruct(tmp_path, tmp_path / "map", {"fitting": {"passes": 0}})
    assert "intrinsics-unknown" in [notice.code for notice in notices(made)]


def test_a_reconstruction_without_depth_is_taken_with_its_poses(tmp_path: Path) -> None:
    found = inspect(write_nerfstudio(tmp_path, 4, depth=False))
    assert found.depth is None
    assert found.tracking.startswith("Tracking with known")
    assert found.poses == 1


def test_the_command_prints_rows_or_one_document(tmp_path: Path) -> None:
    write_scannet(tmp_path / "scan", 4)
    text = run("inspect", str(tmp_path / "scan"))
    rows = dict(line.split(maxsplit=1) for line in text.stdout.splitlines())
    assert rows["frames"] == "4, without times"
    assert rows["depth"].startswith("32 x 24, 1000 units per meter (millimeters): half of it is nearer than 2 m")
    document = json.loads(run("inspect", str(tmp_path / "scan"), "--json").stdout)
    assert document["format"] == "scannet"
    assert document["depth"]["units_per_meter"] == 1000
    assert np.isclose(document["poses"], 1)


def test_an_unknown_folder_is_described(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="is empty"):
        inspect(tmp_path)
