"""PLY files of other Gaussian splatting systems."""

from pathlib import Path

import numpy as np
import pytest
from scenes import random_gaussians, write_standard_ply

from freeocc3d.core.errors import FreeOccError
from freeocc3d.gaussians.point_cloud import write_gaussian_ply
from freeocc3d.gaussians.splat_ply import read_standard_ply
from freeocc3d.gaussians.splat_ply import write_standard_ply as write_ours


@pytest.mark.parametrize("spheres", [False, True])
@pytest.mark.parametrize("harmonics", [0, 45])
def test_what_others_write_is_read_in_natural_units(tmp_path: Path, spheres: bool, harmonics: int) -> None:
    written = random_gaussians(50, seed=0)
    path = write_standard_ply(tmp_path / "point_cloud.ply", written, spheres=spheres, harmonics=harmonics)
    read, labels = read_standard_ply(path)
    assert labels is None
    np.testing.assert_allclose(read.means, written.means, atol=1e-6)
    expected = np.repeat(written.scales[:, :1], 3, axis=1) if spheres else written.scales
    np.testing.assert_allclose(read.scales, expected, rtol=1e-5)
    np.testing.assert_allclose(read.quats_wxyz, written.quats_wxyz, atol=1e-6)
    np.testing.assert_allclose(read.opacities, written.opacities, atol=1e-5)
    np.testing.assert_array_equal(read.colors, written.colors)


def test_labels_come_along_and_broken_gaussians_are_left_out(tmp_path: Path) -> None:
    written = random_gaussians(10, seed=1)
    written.means[3] = np.nan
    written.scales[5] = np.inf
    written.quats_wxyz[7] = 0
    path = write_standard_ply(tmp_path / "p.ply", written, labels=np.arange(10))
    read, labels = read_standard_ply(path)
    assert labels is not None
    assert labels.tolist() == [0, 1, 2, 4, 6, 8, 9]
    assert len(read) == 7


def test_files_that_hold_no_gaussians_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FreeOccError, match="Cannot read"):
        read_standard_ply(tmp_path / "absent.ply")
    (tmp_path / "text.ply").write_text("hello")
    with pytest.raises(FreeOccError, match="not a PLY"):
        read_standard_ply(tmp_path / "text.ply")
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "points.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{axes}end_header\n0 0 0\n")
    with pytest.raises(FreeOccError, match="lack opacity, scale_0"):
        read_standard_ply(tmp_path / "points.ply")
    write_gaussian_ply(random_gaussians(5, seed=0), tmp_path / "own.ply")
    with pytest.raises(FreeOccError, match="internal file of a map"):
        read_standard_ply(tmp_path / "own.ply")
    whole = write_standard_ply(tmp_path / "whole.ply", random_gaussians(500, seed=0)).read_bytes()
    (tmp_path / "half.ply").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FreeOccError, match="damaged"):
        read_standard_ply(tmp_path / "half.ply")
    (tmp_path / "ascii.ply").write_bytes(whole.replace(b"binary_little_endian", b"ascii"))
    with pytest.raises(FreeOccError, match="form 'ascii'"):
        read_standard_ply(tmp_path / "ascii.ply")
    (tmp_path / "many.ply").write_bytes(whole.replace(b"vertex 500", b"vertex 999999999999"))
    with pytest.raises(FreeOccError, match="damaged"):
        read_standard_ply(tmp_path / "many.ply")


def test_what_is_written_is_the_standard_and_reads_back(tmp_path: Path) -> None:
    written = random_gaussians(200, seed=3)
    written.colors[:3] = (255, 0, 0), (0, 255, 0), (12, 34, 56)
    written.opacities[:2] = 0, 1
    write_ours(written, tmp_path / "p.ply")
    header = (tmp_path / "p.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert header[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 200"]
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert header[3:] == [f"property float {name}" for name in names.split()]
    values = np.fromfile(tmp_path / "p.ply", "<f4", offset=(tmp_path / "p.ply").stat().st_size - 200 * 17 * 4)
    assert np.isfinite(values).all()
    logit = np.log(1e-6)  # as close to 0 and to 1 as an opacity is written
    np.testing.assert_allclose(values.reshape(200, 17)[:2, 9], (logit, -logit), atol=0.1)
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * values.reshape(200, 17)[0, 6:9], (1, 0, 0), atol=1e-6)
    read, _ = read_standard_ply(tmp_path / "p.ply")
    np.testing.assert_array_equal(read.means, written.means)
    np.testing.assert_allclose(read.scales, written.scales, rtol=1e-5)
    np.testing.assert_allclose(read.quats_wxyz, written.quats_wxyz, atol=1e-6)
    np.testing.assert_allclose(read.opacities, written.opacities, atol=1e-5)
    np.testing.assert_array_equal(read.colors, written.colors)
