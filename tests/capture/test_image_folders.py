from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scans import write_depth
from small_captures import SIZE, color_image, depth_image, pose_matrix, truncate, write_image, write_matrix

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Options
from freeocc3d.capture.files.image_suffixes import DEPTH_SUFFIXES
from freeocc3d.capture.readers.image_folders import Reader
from freeocc3d.core.errors import CaptureError, FrameError

MILLIMETERS = Options(depth_scale=1000.0)


def write_frames(folder: Path, color: str, depth: str, indices: range = range(4)) -> Path:
    """Frames in files of these patterns, such as ``rgb/{:04d}.png``."""
    for i in indices:
        write_image(folder / color.format(i), color_image(i))
        write_depth(folder / depth.format(i), (depth_image(i) / 1000).astype(np.float32))
    return folder


def check_frames(folder: Path, indices: range = range(4), options: Options | None = None) -> Reader:
    capture = open_capture(folder, options or Options())
    assert isinstance(capture, Reader)
    assert len(capture) == len(indices)
    capture.units_per_meter = None  # as each file usually has it
    for row, i in enumerate(indices):
        frame = capture[row]
        np.testing.assert_array_equal(frame.color, color_image(i))
        np.testing.assert_allclose(frame.depth_m, depth_image(i) / 1000, atol=1e-6)
    return capture


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        ("rgb/{}.png", "depth/{}.png"),
        ("RGB/{}.PNG", "Depth/{:06d}.png"),
        ("image/{}.png", "depth/{:05d}.png"),
        ("images/img_{:03d}.png", "depths/depth_{:03d}.png"),
        ("colour/frame-{:06d}.color.png", "depth_images/frame-{:06d}.depth.png"),
        ("left/cam0_{}_left.png", "depth_imgs/cam0_{}.png"),
        ("color_images/scene0001_00_{:04d}.png", "aligned_depth/{:04d}.png"),
        ("rgb_images/{:05d}.bmp", "depth_image/{:05d}.png"),
        ("imgs/a{}b.webp", "depth/{}.png"),
        ("frame{:04d}.png", "depth{:04d}.png"),
        ("{:04d}-color.png", "{:04d}-depth.png"),
        ("{:04d}.png", "depth/{:04d}.png"),
    ],
)
def test_pairs_of_folders_under_any_names(tmp_path: Path, color: str, depth: str) -> None:
    if color.endswith("webp"):
        color = color.replace("webp", "tiff")
    check_frames(write_frames(tmp_path, color, depth, range(9, 13)), range(9, 13))


@pytest.mark.parametrize("suffix", sorted(DEPTH_SUFFIXES))
def test_depth_of_every_kind_in_a_scannet_layout(tmp_path: Path, suffix: str) -> None:
    capture = open_capture(write_frames(tmp_path, "color/{}.png", "depth/{}" + suffix))
    assert capture.format == "scannet"
    np.testing.assert_allclose(capture[3].depth_m, depth_image(3) / 1000, atol=1e-6)


def test_names_that_count_from_another_start_are_in_order(tmp_path: Path) -> None:
    for i in range(4):
        write_image(tmp_path / f"rgb/{1000 + i}.png", color_image(i))
        write_image(tmp_path / f"depth/{i}.png", depth_image(i))
    check_frames(tmp_path)


def test_unequal_counts_match_by_number_and_say_what_is_left_out(tmp_path: Path) -> None:
    write_frames(tmp_path, "color/{}.png", "depth/{}.png", range(20))
    for i in range(20):
        if i % 5:
            (tmp_path / "depth" / f"{i}.png").unlink()
    capture = check_frames(tmp_path, range(0, 20, 5))
    assert [notice.code for notice in capture.warnings] == ["images-left-out"]
    assert "16 of the 20 color images" in capture.warnings[0].text
    assert "1.png, has no depth image" in capture.warnings[0].text


def test_names_that_do_not_match_are_counted(tmp_path: Path) -> None:
    for i in range(4):
        write_image(tmp_path / f"rgb/{i * i}.png", color_image(i))
        write_image(tmp_path / f"depth/x{50 + i}.png", depth_image(i))
    with pytest.raises(CaptureError, match=r"4 color images \(first rgb/0.png\) and of the 4 depth .*x50.png"):
        open_capture(tmp_path)


def test_depth_beside_color_is_never_denied(tmp_path: Path) -> None:
    check_frames(write_frames(tmp_path / "a", "color/{}.png", "depths/{}.png"))
    for i in range(3):
        write_image(tmp_path / "b" / "color" / f"{i}.png", color_image(i))
        (tmp_path / "b" / "depth").mkdir(exist_ok=True)
        (tmp_path / "b" / "depth" / f"{i}.raw").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"but no depth, for .*depth has 3 \.raw files; \.exr, .*\.png"):
        open_capture(tmp_path / "b")


def test_two_kinds_of_one_image_are_refused(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png")
    for i in range(4):
        write_image(tmp_path / f"rgb/{i}.jpg", color_image(i))
    with pytest.raises(CaptureError, match=r"two images of frame 0, 0\.jpg and 0\.png"):
        open_capture(tmp_path)


def test_hidden_and_other_files_are_no_images(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png")
    for name in ("rgb/._1.png", "rgb/Thumbs.db", "depth/.DS_Store", "rgb/cover_small_2x.png", "depth/._3.png"):
        (tmp_path / name).write_bytes(b"")
    check_frames(tmp_path)


def test_confidence_is_an_uncertainty_or_no_measurement(tmp_path: Path) -> None:
    """As RTAB-Map exports it, with gaps in the numbers, and a smaller depth."""
    for i in (22, 23, 30):
        write_image(tmp_path / "rgb" / f"{i}.png", color_image(i, (96, 72)))
        write_image(tmp_path / "depth" / f"{i}.png", depth_image(i))
        confidence = np.full(SIZE[::-1], 100, np.uint8)
        confidence[:, 10:20], confidence[:, 20:] = 50, 0
        write_image(tmp_path / "confidence" / f"{i}.png", confidence)
    capture = open_capture(tmp_path)
    assert len(capture) == 3
    frame = capture[2]
    assert frame.color.shape == (24, 32, 3)
    assert not frame.depth_m[:, 20:].any()
    assert frame.depth_m[:, 1:20].all()
    assert frame.depth_sigma_m is not None
    assert (frame.depth_sigma_m[:, 10:20] > 1.5 * frame.depth_sigma_m[0, 5]).all()


def test_a_pose_folder(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{:04d}.png", "depth/{:04d}.png")
    for i in (0, 2, 3):
        write_matrix(tmp_path / "poses" / f"{i}.txt", pose_matrix(i))
    capture = open_capture(tmp_path)
    assert capture.pose(1) is None
    np.testing.assert_allclose(capture.pose(2), pose_matrix(2), atol=1e-6)


@pytest.mark.parametrize("name", ["trajectory.log", "traj.txt", "poses.txt"])
def test_a_trajectory_without_times_follows_the_color_images(tmp_path: Path, name: str) -> None:
    """Also if one of them has no depth."""
    write_frames(tmp_path, "rgb/{:04d}.png", "depth/{:04d}.png", range(1, 7))
    (tmp_path / "depth" / "0002.png").unlink()
    rows = []
    for i in range(6):
        matrix = pose_matrix(i)
        if name.endswith(".log"):
            rows.append(f"{i} {i} {i + 1}\n" + "".join(" ".join(map(str, row)) + "\n" for row in matrix.tolist()))
        else:
            rows.append(" ".join(map(str, matrix.reshape(16).tolist())) + "\n")
    (tmp_path / name).write_text("".join(rows))
    capture = open_capture(tmp_path)
    assert len(capture) == 5
    np.testing.assert_allclose(capture.pose(0), pose_matrix(0), atol=1e-6)
    np.testing.assert_allclose(capture.pose(1), pose_matrix(2), atol=1e-6)


def test_a_trajectory_of_another_length_is_told_when_a_pose_is_asked(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{:04d}.png", "depth/{:04d}.png", range(100, 104))
    np.savetxt(tmp_path / "traj.txt", [pose_matrix(i).reshape(16) for i in range(3)])
    capture = open_capture(tmp_path)
    assert capture[0].color.any()
    with pytest.raises(CaptureError, match=r"traj\.txt holds 3 poses for 4 frames"):
        capture.pose(0)


def test_a_camera_file_states_camera_distortion_and_unit(tmp_path: Path) -> None:
    write_frames(tmp_path, "image/{}.png", "depth/{}.png")
    (tmp_path / "camera.json").write_text(
        json.dumps({"fx": 30.0, "fy": 31.0, "cx": 15.0, "cy": 12.0, "k1": 0.01, "depth_scale": 0.00025})
    )
    capture = open_capture(tmp_path)
    assert isinstance(capture, Reader)
    assert (capture.intrinsics_known, capture.units_stated, capture.units_per_meter) == (True, True, 4000.0)
    assert capture.rig(0).color.camera.fx == 30.0
    assert capture.rig(0).color.distortion == (0.01, 0.0, 0.0, 0.0)
    given = open_capture(tmp_path, Options(intrinsics=(40.0, 40.0, 16.0, 12.0)))
    assert given[0].intrinsics.fx == 40.0


def test_nothing_states_a_camera(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png")
    capture = open_capture(tmp_path)
    assert not capture.intrinsics_known
    assert isinstance(capture, Reader)
    assert not capture.units_stated
    assert open_capture(tmp_path, Options(focal=40.0)).intrinsics_known


def test_pictures_of_depth_are_told_at_once(tmp_path: Path) -> None:
    for i in range(3):
        write_image(tmp_path / "rgb" / f"{i}.png", color_image(i))
        write_image(tmp_path / "depth" / f"{i}.png", color_image(i))
    with pytest.raises(CaptureError, match=r"depth/0\.png is not a depth image"):
        open_capture(tmp_path)


def test_pictures_of_depth_beside_depth_are_left_alone(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png")
    for i in range(4):
        write_image(tmp_path / "depth_vis" / f"{i}.png", color_image(i))
    check_frames(tmp_path)


def test_damaged_files_are_broken_frames(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png", range(6))
    truncate(tmp_path / "rgb" / "0.png")
    (tmp_path / "depth" / "1.png").write_bytes(b"")
    (tmp_path / "depth" / "2.png").unlink()
    (tmp_path / "depth" / "2.png").mkdir()
    write_image(tmp_path / "depth" / "3.png", np.ones((12, 16), np.uint16))
    (tmp_path / "rgb" / "4.png").unlink()
    (tmp_path / "rgb" / "4.png").symlink_to("4.png")
    capture = open_capture(tmp_path)
    for index, name in enumerate(("rgb/0", "depth/1", "depth/2", "depth/3", "rgb/4")):
        with pytest.raises(FrameError, match=rf"{name}\.png"):
            capture[index]
    assert capture[5].depth_m.any()


def test_color_alone_can_be_read(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png", range(8, 12))
    capture = open_capture(tmp_path, Options(depth=False))
    assert [int(capture[i].color[0, 0, 2]) for i in range(4)] == [80, 90, 100, 110]
    assert not capture[0].depth_m.any()


def test_a_calibration_of_each_frame(tmp_path: Path) -> None:
    """As RTAB-Map exports them; a frame without one has the camera that is usual, one with a bad one is broken."""
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png", range(20, 24))
    (tmp_path / "calib").mkdir()
    for i in (20, 21, 22):
        matrix = [30.0 + i, 0.0, 16.0, 0.0, 30.0 + i, 12.0, 0.0, 0.0, 1.0]
        (tmp_path / "calib" / f"{i}.yaml").write_text(
            "%YAML:1.0\n---\nimage_width: 32\nimage_height: 24\ncamera_matrix:\n   rows: 3\n   cols: 3\n"
            f"   data: {matrix}\n"
        )
    (tmp_path / "calib" / "22.yaml").write_text("nothing")
    capture = open_capture(tmp_path)
    assert capture.intrinsics_known
    assert [capture[i].intrinsics.fx for i in (0, 1)] == [50.0, 51.0]
    with pytest.raises(FrameError, match=r"22\.yaml states no camera"):
        capture[2]
    assert capture[3].depth_m.any()
    assert open_capture(tmp_path, Options(focal=40.0))[2].intrinsics.fx == 40.0


@pytest.mark.parametrize("name", ["trajectory.log", "K.txt", "camera_intrinsic.json", "rgb/2.png", "depth/2.png"])
@pytest.mark.parametrize("target", ["pipe", "/dev/zero", "loop", "folder"])
def test_a_hostile_file_ends_in_a_sentence(tmp_path: Path, name: str, target: str) -> None:
    path = write_frames(tmp_path, "rgb/{}.png", "depth/{}.png") / name
    path.unlink(missing_ok=True)
    if target == "pipe":
        os.mkfifo(path)
    elif target == "folder":
        path.mkdir()
    else:
        path.symlink_to(path if target == "loop" else target)
    with pytest.raises((CaptureError, FrameError), match=path.stem):
        read_frame(tmp_path, 2)


def read_frame(folder: Path, index: int) -> None:
    capture = open_capture(folder)
    capture[index]
    capture.pose(index)


@pytest.mark.parametrize("loop", ["rgb", "depth", "pose", "calib"])
def test_a_folder_that_is_a_loop_of_links_is_none(tmp_path: Path, loop: str) -> None:
    write_frames(tmp_path, "color_images/{}.png", "depths/{}.png")
    (tmp_path / loop).symlink_to(loop)
    check_frames(tmp_path)


@pytest.mark.parametrize("color", ["rgb", "color"])
def test_the_focal_length_of_photographs_is_stated_roughly(tmp_path: Path, color: str) -> None:
    """Each of three images states it; other readers of folders do the same."""
    for i in range(3):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA405] = 26  # 35 mm equivalent
        (tmp_path / color).mkdir(exist_ok=True)
        Image.fromarray(color_image(i)).save(tmp_path / color / f"{i}.jpg", exif=exif)
        write_image(tmp_path / "depth" / f"{i}.png", depth_image(i))
    capture = open_capture(tmp_path)
    assert (capture.intrinsics_known, capture.focal_stated) == (False, True)
    assert capture[1].intrinsics.fx == pytest.approx(26 / 43.27 * np.hypot(*SIZE), rel=1e-3)
    given = open_capture(tmp_path, Options(focal=40.0))
    assert (given.intrinsics_known, given[1].intrinsics.fx) == (True, 40.0)
    exif.get_ifd(0x8769)[0xA405] = 52  # of another lens
    Image.fromarray(color_image(2)).save(tmp_path / color / "2.jpg", exif=exif)
    assert not open_capture(tmp_path).focal_stated
