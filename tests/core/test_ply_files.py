"""PLY files: what is written reads back, and the size of a file is checked against its header."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from freeocc3d.core.errors import FreeOccError
from freeocc3d.core.ply_files import read_ply_header, read_ply_vertices, write_ply


def vertices(count: int) -> np.ndarray:
    rows = np.zeros(count, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("id", "<i4")])
    rows["x"], rows["red"], rows["id"] = np.arange(count), 7, -np.arange(count)
    return rows


def test_what_is_written_reads_back_and_in_open3d(tmp_path: Path) -> None:
    quads = np.array([[0, 1, 2, 3]], np.int32)
    write_ply(tmp_path / "a.ply", vertices(4), quads, ["of a test"])
    np.testing.assert_array_equal(read_ply_vertices(tmp_path / "a.ply"), vertices(4))
    header = read_ply_header(tmp_path / "a.ply")
    assert [(name, count) for name, count, _ in header.elements] == [("vertex", 4), ("face", 1)]
    points = np.asarray(o3d.io.read_point_cloud(str(tmp_path / "a.ply")).points)
    np.testing.assert_array_equal(points[:, 0], np.arange(4))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"", "not a PLY"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n", "not a PLY"),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "header cannot be read"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty text x\nend_header\n", "header cannot be read"),
        (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "header cannot be read"),
        (b"ply\nformat ascii 1.0\nelement vertex 9000000000\nproperty float x\nend_header\n0\n", "damaged"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty double x\nend_header\n12345678", "damaged"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nelement face 9\n"
            b"property list uchar int vertex_indices\nend_header\n12345678",
            "damaged",
        ),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nproperty float x\nend_header\n", "header cannot be read"),
        (b"ply\nformat ascii 1.0\nelement vertex " + b"9" * 5000 + b"\nend_header\n", "header cannot be read"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float\nend_header\n", "header cannot be read"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x y\nend_header\n", "header cannot be read"),
        (b"ply\nelement\nend_header\n", "header cannot be read"),
        (b"ply\n" + b"x" * 100_000 + b"\nend_header\n", "not a PLY"),
    ],
)
def test_headers_that_the_file_does_not_bear_out_are_refused(tmp_path: Path, text: bytes, said: str) -> None:
    (tmp_path / "a.ply").write_bytes(text)
    with pytest.raises(FreeOccError, match=said):
        read_ply_header(tmp_path / "a.ply")


def test_a_file_that_must_end_with_its_vertices_has_just_their_length(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, vertices(4))
    whole = path.read_bytes()
    assert len(read_ply_vertices(path, alone=True)) == 4
    path.write_bytes(whole + b"x")
    assert len(read_ply_vertices(path)) == 4
    with pytest.raises(FreeOccError, match="not as long as its header states"):
        read_ply_vertices(path, alone=True)
    for cut in (1, 10, len(whole) // 2):
        path.write_bytes(whole[:-cut])
        with pytest.raises(FreeOccError, match=r"damaged|not a PLY"):
            read_ply_vertices(path)


def test_big_endian_vertices_come_in_the_order_of_the_machine(tmp_path: Path) -> None:
    rows = vertices(3)
    header = b"ply\nformat binary_big_endian 1.0\nelement vertex 3\n" + b"".join(
        f"property {kind} {name}\n".encode()
        for name, kind in zip(rows.dtype.names or (), ("float", "float", "float", "uchar", "int"), strict=True)
    )
    (tmp_path / "a.ply").write_bytes(header + b"end_header\n" + rows.astype(rows.dtype.newbyteorder(">")).tobytes())
    found = read_ply_vertices(tmp_path / "a.ply")
    assert found.dtype.isnative
    np.testing.assert_array_equal(found, rows)


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, lambda path: path.symlink_to(path.name)])
def test_what_is_no_regular_file_is_not_opened(tmp_path: Path, make: Callable[[Path], object]) -> None:
    make(tmp_path / "a.ply")
    with pytest.raises(FreeOccError, match="Cannot read"):
        read_ply_vertices(tmp_path / "a.ply")
