"""COLMAP's files: as pycolmap reads them, and every damage of their structure in a sentence at once."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from freeocc3d.capture.poses.colmap_models import PARAMETERS, ColmapModel, read_colmap_model
from freeocc3d.core.errors import CaptureError

NAMES = ("cameras", "images", "points3D")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of pycolmap's, as text and binary: two cameras, five images, of which points see some or all."""
    folder = tmp_path_factory.mktemp("model")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 1, 3
    options.num_points3D, options.num_points2D_without_point3D = 20, 4
    model = pycolmap.synthesize_dataset(options)
    for form in ("bin", "txt"):
        (folder / form).mkdir()
    model.write_binary(str(folder / "bin"))
    model.write_text(str(folder / "txt"))
    return folder


def copy(model: Path, folder: Path) -> Path:
    for path in model.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def seen_points(model: ColmapModel) -> dict[str, list[int]]:
    return {image.name: sorted(image.seen.tolist()) for image in model.images}


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_a_model_is_read_as_pycolmap_reads_it(written: Path, form: str) -> None:
    found, true = read_colmap_model(written / form), pycolmap.Reconstruction(str(written / form))
    assert len(found.images) == len(true.images) == 6
    for image in found.images:
        other = next(one for one in true.images.values() if one.name == image.name)
        np.testing.assert_allclose(image.T_cam_world[:3], other.cam_from_world().matrix(), atol=1e-12)
        assert image.camera == other.camera_id
        ids = [point.point3D_id for point in other.get_observation_points2D()]
        assert sorted(image.seen.tolist()) == sorted(ids)
        assert len(ids) < len(other.points2D)
    for number, camera in found.cameras.items():
        assert camera.params == tuple(true.cameras[number].params)
        assert (camera.width, camera.height) == (true.cameras[number].width, true.cameras[number].height)
    rows = found.rows(np.array(sorted(true.points3D), np.uint64))
    positions = [true.points3D[number].xyz for number in sorted(true.points3D)]
    np.testing.assert_allclose(found.points[rows], positions, atol=1e-12)


def test_both_forms_are_equal(written: Path) -> None:
    binary, text = read_colmap_model(written / "bin"), read_colmap_model(written / "txt")
    assert seen_points(binary) == seen_points(text)
    assert binary.cameras == text.cameras
    np.testing.assert_array_equal(binary.points, text.points)


def test_the_camera_models_are_pycolmaps() -> None:
    known = [kind for kind in pycolmap.CameraModelId.__members__.values() if kind.value >= 0]
    assert [kind.name for kind in sorted(known, key=lambda kind: kind.value)] == list(PARAMETERS)
    for name, parameters in PARAMETERS.items():
        stated = pycolmap.Camera.create_from_model_name(1, name, 100.0, 64, 48).params_info
        assert stated.replace(",", " ").split() == parameters.split()


@pytest.mark.parametrize("name", NAMES)
def test_a_file_cut_at_any_byte_is_refused(written: Path, tmp_path: Path, name: str) -> None:
    """pycolmap loops without end on some of them."""
    path = copy(written / "bin", tmp_path) / f"{name}.bin"
    data = path.read_bytes()
    for length in range(0, len(data), max(1, len(data) // 150)):
        path.write_bytes(data[:length])
        with pytest.raises(CaptureError, match=rf"no readable COLMAP model.*{name}\.bin cannot be read"):
            read_colmap_model(tmp_path)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("count", [0, 1, 7, 1 << 32, 1 << 40, (1 << 64) - 1])
def test_a_wrong_count_is_refused(written: Path, tmp_path: Path, name: str, count: int) -> None:
    path = copy(written / "bin", tmp_path) / f"{name}.bin"
    data = path.read_bytes()
    path.write_bytes(struct.pack("<Q", count) + data[8:])
    with pytest.raises(CaptureError, match=rf"{name}\.bin cannot be read"):
        read_colmap_model(tmp_path)


def test_a_wrong_length_of_a_track_or_of_observations_is_refused(written: Path, tmp_path: Path) -> None:
    copy(written / "bin", tmp_path)
    for name, at in (("points3D", 8 + 8 + 24 + 3 + 8), ("images", 8 + 4 + 56 + 4)):
        data = bytearray((written / "bin" / f"{name}.bin").read_bytes())
        at = data.index(b"\0", at) + 1 if name == "images" else at
        for length in (1 << 20, 1 << 61, (1 << 64) - 1):
            struct.pack_into("<Q", data, at, length)
            (tmp_path / f"{name}.bin").write_bytes(data)
            with pytest.raises(CaptureError, match=rf"{name}\.bin cannot be read: it ends before"):
                read_colmap_model(tmp_path)
        copy(written / "bin", tmp_path)


@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        ("cameras", " 1024 ", " 0 ", "no possible size"),
        ("cameras", " 1024 ", " 99999999999 ", "no possible size"),
        ("cameras", "SIMPLE_RADIAL", "PANORAMA", "no camera model PANORAMA"),
        ("cameras", "SIMPLE_RADIAL", "OPENCV", "no camera model OPENCV of 4"),
        ("cameras", "SIMPLE_RADIAL 1024 768 1280", "SIMPLE_RADIAL 1024 768 nan", "no possible size or parameters"),
        ("images", " 1 ", " nan ", r"images\.txt cannot be read"),
        ("points3D", "\n1 ", "\nx ", r"points3D\.txt cannot be read"),
        ("points3D", "\n1 ", "\n1 nan ", "no possible position"),
        ("points3D", "\n1 ", "\n1 1e300 ", "no possible position"),
        ("points3D", "\n1 ", "\n2 ", "listed twice"),
    ],
)
def test_damaged_text_is_refused(written: Path, tmp_path: Path, name: str, old: str, new: str, told: str) -> None:
    path = copy(written / "txt", tmp_path) / f"{name}.txt"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(CaptureError, match=told):
        read_colmap_model(tmp_path)


def test_parts_that_do_not_fit_each_other_are_refused(written: Path, tmp_path: Path) -> None:
    for name, told in (("points3D", "sees points that points3D lacks"), ("cameras", "has camera 1, which is missing")):
        path = copy(written / "txt", tmp_path) / f"{name}.txt"
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        path.write_text("\n".join(line for line in lines if not line.startswith("1 ")) + "\n")
        with pytest.raises(CaptureError, match=told):
            read_colmap_model(tmp_path)


def test_an_impossible_focal_length_is_refused(written: Path, tmp_path: Path) -> None:
    path = copy(written / "txt", tmp_path) / "cameras.txt"
    path.write_text("1 PINHOLE 640 480 1e-30 1e8 320 240\n2 PINHOLE 640 480 500 500 320 240\n")
    with pytest.raises(CaptureError, match="unusable intrinsics"):
        read_colmap_model(tmp_path).cameras[1].lens("model")
    assert read_colmap_model(tmp_path).cameras[2].lens("model").camera.fx == 500
