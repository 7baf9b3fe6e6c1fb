from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from freeocc3d.capture.cameras.camera_discovery import find_cameras
from freeocc3d.core.errors import CaptureError
from freeocc3d.core.types import Intrinsics

SIZE = 640, 480
VALUES = 517.3, 516.5, 318.6, 255.3
FX, FY, CX, CY = VALUES
MATRIX = [FX, 0, CX, 0, FY, CY, 0, 0, 1]
ROWS = f"{FX} 0 {CX}\n0 {FY} {CY}\n0 0 1\n"
WIDE = f"{FX} 0 {CX} 0 0 {FY} {CY} 0 0 0 1 0 0 0 0 1"

ROS = """image_width: 640
image_height: 480
camera_name: rgb
camera_matrix:
  rows: 3
  cols: 3
  data: [517.3, 0.0, 318.6, 0.0, 516.5, 255.3, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.25, -0.9, -0.005, 0.002, 1.1]
projection_matrix:
  rows: 3
  cols: 4
  data: [500, 0, 318.6, 0, 0, 500, 255.3, 0, 0, 0, 1, 0]
"""
ROS_MESSAGE = f"""header:
  seq: 4
height: 480
width: 640
distortion_model: "plumb_bob"
D: [0.25, -0.9, -0.005, 0.002, 1.1]
K: {MATRIX}
R: [1, 0, 0, 0, 1, 0, 0, 0, 1]
---
"""
ORB_SLAM = """%YAML:1.0

# Camera
Camera.fx: 517.3
Camera.fy: 516.5
Camera.cx: 318.6
Camera.cy: 255.3
Camera.k1: 0.25
Camera.k2: -0.9
Camera.p1: -0.005
Camera.p2: 0.002
Camera.k3: 1.1
Camera.width: 640
Camera.height: 480
DepthMapFactor: 5000.0
"""
ORB_SLAM_3 = ORB_SLAM.replace("Camera.", "Camera1.").replace("DepthMapFactor", "RGBD.DepthMapFactor")
DISTORTION = 0.25, -0.9, -0.005, 0.002, 1.1

OPEN3D = {"width": 640, "height": 480, "intrinsic_matrix": [FX, 0, 0, 0, FY, 0, CX, CY, 1]}
NESTED = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}

FORMS = {
    "camera_intrinsic.json": json.dumps(OPEN3D),
    "intrinsic.json": json.dumps({"class_name": "PinholeCameraParameters", "intrinsic": OPEN3D}),
    "cam_params.json": json.dumps({"camera": {"w": 640, "h": 480, **NESTED}}),
    "camera.json": json.dumps({"FX": FX, "Fy": FY, "Cx": CX, "cY": CY}),
    "intrinsics.json": json.dumps({"intrinsics": {"fx": FX, "fy": FY, "ppx": CX, "ppy": CY}, "width": 640, "h": 480}),
    "info.json": json.dumps({"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": 640, "h": 480}),
    "calibration.json": json.dumps({"K": [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]}),
    "settings.json": json.dumps({"focal_length": [FX, FY], "principal_point": [CX, CY]}),
    "K.txt": ROWS,
    "camera.txt": ROWS.replace("\n", " 0\n") + "0 0 0 1\n",
    "camera_matrix.csv": ROWS.replace(" ", ","),
    "intrinsics.txt": f"{FX} {FY} {CX} {CY}\n",
    "calib.txt": f"# fx fy cx cy\n{FX} {FY} {CX} {CY}",
    "camera_info.txt": f"fx: {FX}\nfy: {FY}\ncx: {CX}\ncy: {CY}\n",
    "cam.txt": f"fx = {FX}\r\nfy = {FY}\r\ncx = {CX}\r\ncy = {CY}\r\n",
    "params.txt": f"fx {FX}\nfy {FY}\ncx {CX}\ncy {CY}\n",
    "intrinsic_color.txt": f"640 480\n{ROWS}",
    "scene0000_00.txt": f"colorWidth = 640\ncolorHeight = 480\nfx_color = {FX}\nfy_color = {FY}\nmx_color = {CX}\n"
    f"my_color = {CY}\naxisAlignment = {WIDE.replace(str(FX), '1')}\n",
    "_info.txt": f"m_colorWidth = 640\nm_colorHeight = 480\nm_calibrationColorIntrinsic = {WIDE} \n",
    "kalibr.yaml": f"cam0:\n  intrinsics: [{FX}, {FY}, {CX}, {CY}]\n  resolution: [640, 480]\ncam1:\n  intrinsics: "
    f"[1, 1, 1, 1]\n",
}


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("place", ["", "intrinsic", "above"])
def test_a_camera_in_a_file_of_a_usual_form(tmp_path: Path, name: str, place: str) -> None:
    folder = tmp_path / "scan"
    folder.mkdir()
    path = {"": folder, "intrinsic": folder / "intrinsic", "above": tmp_path}[place] / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(FORMS[name])
    color = find_cameras(folder, SIZE, SIZE).stated.color
    if place == "above" and color is None:
        assert name in ("settings.json", "params.txt", "scene0000_00.txt", "kalibr.yaml"), "another folder's, perhaps"
        return
    assert color is not None
    assert color.camera == Intrinsics(*SIZE, *VALUES)
    assert not any(color.distortion)


@pytest.mark.parametrize(
    ("name", "text", "units"),
    [
        ("rgb.yaml", ROS, None),
        ("camera_info.yaml", ROS_MESSAGE, None),
        ("TUM1.yaml", ORB_SLAM, 5000.0),
        ("RealSense.yaml", ORB_SLAM_3, 5000.0),
    ],
)
def test_yaml_with_distortion(tmp_path: Path, name: str, text: str, units: float | None) -> None:
    (tmp_path / name).write_text(text)
    found = find_cameras(tmp_path, SIZE, SIZE)
    assert found.stated.color is not None
    assert found.stated.color.camera == Intrinsics(*SIZE, *VALUES)
    assert found.stated.color.distortion == DISTORTION
    assert found.units_per_meter == units


def test_opencvs_own_writer(tmp_path: Path) -> None:
    storage = cv2.FileStorage(str(tmp_path / "calibration.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array(MATRIX).reshape(3, 3))
    storage.write("distortion_coefficients", np.array([DISTORTION]))
    storage.release()
    color = find_cameras(tmp_path, SIZE, SIZE).stated.color
    assert color is not None
    assert (color.camera, color.distortion) == (Intrinsics(*SIZE, *VALUES), DISTORTION)


def test_two_cameras_and_a_unit_in_one_document(tmp_path: Path) -> None:
    depth = {"fx": 400.0, "fy": 401.0, "cx": 300.0, "cy": 200.0, "coeffs": [0.0] * 5}
    infrared = {"fx": 1.0, "fy": 1.0}
    document = {"infrared1": infrared, "color": NESTED, "depth": depth, "depth_scale": 0.001, "depth_units": "m"}
    (tmp_path / "intrinsics.json").write_text(json.dumps(document))
    found = find_cameras(tmp_path, SIZE, SIZE)
    assert found.stated.color is not None
    assert found.stated.depth is not None
    assert (found.stated.color.camera.fx, found.stated.depth.camera.fx) == (FX, 400.0)
    assert found.units_per_meter == 1000.0


def test_a_fisheye(tmp_path: Path) -> None:
    (tmp_path / "calib.json").write_text(json.dumps({**NESTED, "model": "KANNALA_BRANDT4", "coeffs": [0.1, 0.2, 0, 0]}))
    color = find_cameras(tmp_path, SIZE, None).stated.color
    assert color is not None
    assert (color.fisheye, color.distortion) == (True, (0.1, 0.2, 0.0, 0.0))


def test_files_that_agree_are_one_and_the_distortion_counts(tmp_path: Path) -> None:
    (tmp_path / "K.txt").write_text(ROWS)
    (tmp_path / "camera.yaml").write_text(ROS)
    color = find_cameras(tmp_path, SIZE, SIZE).stated.color
    assert color is not None
    assert color.distortion == DISTORTION


def test_files_that_disagree_are_both_named(tmp_path: Path) -> None:
    (tmp_path / "K.txt").write_text(ROWS)
    (tmp_path / "camera.json").write_text(json.dumps({**NESTED, "fx": 700.0}))
    with pytest.raises(CaptureError, match=r"K\.txt and .*camera\.json state different cameras"):
        find_cameras(tmp_path, SIZE, SIZE)


def test_units_that_disagree_are_both_named(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(ORB_SLAM)
    (tmp_path / "b.yaml").write_text(ORB_SLAM.replace("5000", "1000"))
    with pytest.raises(CaptureError, match=r"a\.yaml states 5000 .*b\.yaml states 1000"):
        find_cameras(tmp_path, SIZE, SIZE)


def test_the_own_folder_counts_before_the_parent(tmp_path: Path) -> None:
    (tmp_path / "scan").mkdir()
    (tmp_path / "K.txt").write_text(ROWS.replace("517.3", "700"))
    (tmp_path / "scan" / "K.txt").write_text(ROWS)
    color = find_cameras(tmp_path / "scan", SIZE, SIZE).stated.color
    assert color is not None
    assert color.camera.fx == FX


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("config.json", "{"),
        ("notes.txt", "fx 500"),
        ("config.yaml", "fx: [}"),
        ("poses.txt", f"{FX} {FY} {CX} {CY}"),
        ("camera_extrinsics.txt", ROWS),
        ("camera.txt", "a camera of 2012"),
        ("info.txt", "1 2 3"),
        ("config.yaml", "a: &a [1]\nb: [*a, *a]\n"),
        ("camera.json", json.dumps({"fx": 0.8, "fy": 0.8, "cx": 0.5, "cy": 0.5})),
        ("big.yaml", ROS + "#" * (1 << 17)),
    ],
)
def test_other_files_state_nothing(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert find_cameras(tmp_path, SIZE, SIZE).stated.color is None


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("intrinsics.txt", "1 2 3", "states no camera that is understood"),
        ("camera_intrinsic.json", "{", "states no camera that is understood"),
        ("intrinsics.json", json.dumps({**NESTED, "width": 1920, "height": 1080}), "for images of 1920 x 1080"),
        ("K.txt", ROWS.replace("318.6", "960"), "outside the 640 x 480 image"),
    ],
)
def test_a_calibration_that_is_not_usable_is_told(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CaptureError, match=message):
        find_cameras(tmp_path, SIZE, SIZE)


@pytest.mark.parametrize("key", ["fx", "fy", "cx", "k1", "depth_scale", "scale", "width", "K"])
@pytest.mark.parametrize("form", ["json", "yaml"])
def test_numbers_that_no_float_holds(tmp_path: Path, key: str, form: str) -> None:
    """JSON and YAML write whole numbers of any length."""
    stated = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, key: [10**400] * 9 if key == "K" else 10**400}
    text = json.dumps(stated) if form == "json" else "".join(f"{name}: {value}\n" for name, value in stated.items())
    (tmp_path / f"camera.{form}").write_text(text)
    try:
        found = find_cameras(tmp_path, SIZE, SIZE)
    except CaptureError as error:
        assert "camera." in str(error)  # noqa: PT017, most keys are left out without a word
    else:
        assert found.units_per_meter is None


def test_a_camera_of_the_depths_size_is_the_depths(tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(json.dumps({**NESTED, "width": 640, "height": 480}))
    stated = find_cameras(tmp_path, (1920, 1080), (640, 480)).stated
    assert stated.color is None
    assert stated.depth is not None


def test_a_file_of_each_frame_is_no_calibration(tmp_path: Path) -> None:
    (tmp_path / "intrinsics").mkdir()
    for i in range(100):
        (tmp_path / "intrinsics" / f"intrinsics_{i}.txt").write_text(ROWS.replace("517.3", str(500 + i)))
    assert find_cameras(tmp_path, SIZE, SIZE).stated.color is None
