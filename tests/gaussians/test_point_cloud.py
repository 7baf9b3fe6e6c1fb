"""Gaussians as Open3D's point cloud, and as its file."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import random_gaussians

from freeocc3d.core.errors import MapError
from freeocc3d.core.types import Gaussians
from freeocc3d.gaussians.point_cloud import read_gaussian_ply, to_point_cloud, write_gaussian_ply


def test_gaussians_survive_the_point_cloud_and_the_file_exactly(tmp_path) -> None:
    g = random_gaussians(50, seed=0)
    write_gaussian_ply(g, tmp_path / "g.ply")
    again = read_gaussian_ply(tmp_path / "g.ply")
    for name in g.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(g, name))
        assert getattr(again, name).dtype == getattr(g, name).dtype


def test_the_point_cloud_shares_memory(tmp_path) -> None:
    g = random_gaussians(5, seed=1)
    cloud = to_point_cloud(g)
    g.scales[2] = 7.0
    assert (cloud.point["scale"].numpy()[2] == 7.0).all()


def with_first(g: Gaussians, name: str, value: float) -> Gaussians:
    values = getattr(g, name).copy()
    values[0] = value
    return replace(g, **{name: values})


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("means", np.nan, "means that are not finite"),
        ("means", 1e38, "means that are too far away"),
        ("means", 1e10, "means that are too far away"),
        ("scales", 0, "scales that are not positive"),
        ("scales", -1, "scales that are not positive"),
        ("scales", np.nan, "scales that are not positive"),
        ("scales", 1e38, "scales that are not positive"),
        ("quats_wxyz", 0, "no unit quaternions"),
        ("quats_wxyz", 1, "no unit quaternions"),
        ("quats_wxyz", np.nan, "no unit quaternions"),
        ("opacities", -0.1, "opacities outside 0 to 1"),
        ("opacities", 1.1, "opacities outside 0 to 1"),
        ("opacities", np.nan, "opacities outside 0 to 1"),
        ("anchor_cam", np.nan, "anchors that are not finite"),
        ("anchor_keyframe", 3, "keyframes that the map does not have"),
        ("anchor_keyframe", -1, "keyframes that the map does not have"),
    ],
)
def test_gaussians_that_cannot_be_are_refused(tmp_path: Path, name: str, value: float, said: str) -> None:
    g = with_first(random_gaussians(50, seed=0), "anchor_keyframe", 2)
    write_gaussian_ply(with_first(g, name, value), tmp_path / "g.ply")
    with pytest.raises(MapError, match=rf"g\.ply is damaged: it holds .*{said}"):
        read_gaussian_ply(tmp_path / "g.ply", keyframes=3)


HEADERS: dict[str, Callable[[bytes], bytes]] = {
    "two billion points": lambda data: data.replace(b"vertex 50", b"vertex 2000000000"),
    "one point more": lambda data: data.replace(b"vertex 50", b"vertex 51"),
    "one point less": lambda data: data.replace(b"vertex 50", b"vertex 49"),
    "doubles": lambda data: data.replace(b"property int keyframe", b"property double keyframe"),
    "another type of the same size": lambda data: data.replace(b"property int keyframe", b"property float keyframe"),
    "a property twice": lambda data: data.replace(b"property float y", b"property float x"),
    "a list": lambda data: data.replace(b"property float y", b"property list uchar float y"),
    "text": lambda data: data.replace(b"binary_little_endian", b"ascii"),
    "half of it": lambda data: data[: len(data) // 2 + 200],
    "more of it": lambda data: data + bytes(67),
    "zeros": lambda data: data[:-1000] + bytes(1000),
}


@pytest.mark.parametrize("kind", HEADERS)
def test_files_that_their_header_does_not_describe_are_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "g.ply"
    write_gaussian_ply(random_gaussians(50, seed=0), path)
    damaged = HEADERS[kind](path.read_bytes())
    assert damaged != path.read_bytes()
    path.write_bytes(damaged)
    with pytest.raises(MapError, match=r"g\.ply"):
        read_gaussian_ply(path)
