"""The export of Gaussians: upright, and read by another author's program."""

import contextlib
import json
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from exported_maps import CAMERA_TO_UP
from scenes import random_gaussians
from scipy.spatial import cKDTree

from freeocc3d.core.errors import ExportError
from freeocc3d.core.transforms import quats_to_rotations, transform
from freeocc3d.export import export_map
from freeocc3d.gaussians.splat_ply import read_standard_ply


def map_of(gaussians, up=(0.0, -1.0, 0.0)):
    return SimpleNamespace(gaussians=gaussians, up=np.array(up), metric=True)


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0.6, 0, -0.8), (0, 1, 0)])
def test_up_becomes_minus_y_and_nothing_is_bent(tmp_path: Path, up) -> None:
    g = random_gaussians(60, seed=1)
    export_map(map_of(g, up), "gaussians", tmp_path / "g.ply")
    read, _ = read_standard_ply(tmp_path / "g.ply")
    np.testing.assert_allclose(-read.means[:, 1], g.means @ np.float32(up), atol=1e-5)
    R = np.linalg.lstsq(g.means, read.means, rcond=None)[0].T
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-4)
    assert np.linalg.det(R) > 0
    expected = R @ quats_to_rotations(g.quats_wxyz)
    np.testing.assert_allclose(quats_to_rotations(read.quats_wxyz), expected, atol=1e-4)
    np.testing.assert_allclose(read.scales, g.scales, rtol=1e-5)


def test_the_maps_own_frame_can_be_kept(tmp_path: Path) -> None:
    g = random_gaussians(60, seed=1)
    export_map(map_of(g, (0, 0, 1)), "gaussians", tmp_path / "g.ply", {"upright": False})
    np.testing.assert_array_equal(read_standard_ply(tmp_path / "g.ply")[0].means, g.means)


def test_the_floor_is_at_0_in_the_gravity_frame(tmp_path: Path) -> None:
    g = random_gaussians(60, seed=1)
    scan_map = map_of(g)
    scan_map.T_gravity_map = CAMERA_TO_UP
    height = 1.52 - g.means[:, 1]
    export_map(scan_map, "gaussians", tmp_path / "g.ply", {"frame": "gravity"})
    read = read_standard_ply(tmp_path / "g.ply")[0]
    np.testing.assert_allclose(-read.means[:, 1], height, atol=1e-5)
    T = np.array(json.loads((tmp_path / "g.ply.json").read_text())["T_file_map"])
    np.testing.assert_allclose(transform(T, g.means.astype(float)), read.means, atol=1e-5)
    export_map(scan_map, "gaussians", tmp_path / "z.ply", {"frame": "gravity", "upright": False})
    np.testing.assert_allclose(read_standard_ply(tmp_path / "z.ply")[0].means[:, 2], height, atol=1e-5)


def test_a_map_without_gaussians_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="no Gaussians"):
        export_map(map_of(random_gaussians(0, seed=0)), "gaussians", tmp_path / "g.ply")
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def splat_transform(tmp_path_factory) -> list[str]:
    """PlayCanvas's converter, if it is installed or npm can fetch it."""
    if found := shutil.which("splat-transform"):
        return [found]
    if npx := shutil.which("npx"):
        command = [npx, "--yes", "@playcanvas/splat-transform@2.7.1"]
        folder = tmp_path_factory.mktemp("npm")
        with contextlib.suppress(subprocess.SubprocessError, OSError):
            subprocess.run([*command, "--version"], check=True, capture_output=True, timeout=120, cwd=folder)
            return command
    pytest.skip("splat-transform is not installed, and npm cannot fetch it")


def exported(tmp_path: Path, command: list[str], target: str):
    """Gaussians of random colors, and what the converter made of their export."""
    g = random_gaussians(300, seed=2)
    g.colors[:] = np.random.default_rng(2).integers(0, 256, g.colors.shape)
    export_map(map_of(g), "gaussians", tmp_path / "g.ply")
    subprocess.run([*command, "g.ply", target], check=True, capture_output=True, timeout=120, cwd=tmp_path)
    return g, tmp_path / target


def test_splat_transform_reads_what_was_written(tmp_path: Path, splat_transform) -> None:
    g, path = exported(tmp_path, splat_transform, "g.csv")
    read = np.genfromtxt(path, delimiter=",", names=True)
    columns = {name: read[name] for name in read.dtype.names}
    np.testing.assert_allclose(np.stack([columns[axis] for axis in "xyz"], 1), g.means, atol=1e-6)
    np.testing.assert_allclose(np.exp(np.stack([columns[f"scale_{i}"] for i in range(3)], 1)), g.scales, rtol=1e-5)
    np.testing.assert_allclose(np.stack([columns[f"rot_{i}"] for i in range(4)], 1), g.quats_wxyz, atol=1e-6)


def test_splat_transform_sees_the_colors_and_opacities_that_were_written(tmp_path: Path, splat_transform) -> None:
    """Its compressed PLY holds red, green, blue and opacity as it decodes them, 8 bits each of a block's range."""
    g, path = exported(tmp_path, splat_transform, "g.compressed.ply")
    header, _, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property float")]
    blocks = np.frombuffer(body, "<f4", -(-len(g) // 256) * len(names)).reshape(-1, len(names))
    packed = np.frombuffer(body, "<u4", 4 * len(g), blocks.nbytes).reshape(-1, 4)
    block = np.arange(len(g)) // 256

    def decoded(word: int, bits: tuple[int, ...], channels: str) -> np.ndarray:
        shifts = 32 - np.cumsum(bits)
        shares = (packed[:, word, None] >> shifts.astype(np.uint32) & (2 ** np.array(bits) - 1)) / (
            2.0 ** np.array(bits) - 1
        )
        low, high = (blocks[block][:, [names.index(f"{end}_{c}") for c in channels]] for end in ("min", "max"))
        return low + shares[:, : len(channels)] * (high - low)

    _, written = cKDTree(g.means).query(decoded(0, (11, 10, 11), "xyz"))
    assert len(set(written)) == len(g)
    np.testing.assert_allclose(255 * decoded(3, (8, 8, 8, 8), "rgb"), g.colors[written], atol=0.6)
    np.testing.assert_allclose((packed[:, 3] & 255) / 255, g.opacities[written], atol=0.6 / 255)
