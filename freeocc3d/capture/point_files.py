"""Reads the point cloud of a capture or trajectory: PLY, PCD or XYZ.

Open3D reads only PCD, and only after its header is checked: of a damaged file, its readers believe every count.

Source: the Point Cloud Library's "PCD (Point Cloud Data) file format".
"""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FreeOccError
from ..core.ply_files import PlyHeader, read_ply_header, read_ply_vertices
from ..core.regular_files import check_content, open_regular, read_bytes
from .cameras.camera_files import FARTHEST

_MOST_BYTES = 1 << 30
_MOST_TEXT_BYTES = 256 << 20
_LONGEST_HEADER = 1 << 12


def read_points(path: Path) -> NDArray[np.float64]:
    """Read (P, 3) finite points, in the file's unit. Raises CaptureError: no such file, no points, or damaged."""
    try:
        check_content(path, _MOST_BYTES)
        suffix = path.suffix.lower()
        points = _ply_points(path) if suffix == ".ply" else _pcd_points(path) if suffix == ".pcd" else _xyz_points(path)
    except OSError as error:
        raise CaptureError(f"Cannot read the point cloud {path}: {error.strerror}.") from error
    except (ValueError, FreeOccError) as error:
        raise CaptureError(f"{path} is not a readable point cloud (PLY, PCD or XYZ): {error}") from error
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise CaptureError(f"{path} holds no points, or is not a readable point cloud (PLY, PCD or XYZ).")
    if np.abs(points).max() > FARTHEST:
        raise CaptureError(f"{path} holds a point that is farther away than is possible: correct it.")
    return points


def _ply_points(path: Path) -> NDArray[np.float64]:
    header = read_ply_header(path)
    names = [line[-1] for line in header.elements[0][2]]
    if header.elements[0][0] != "vertex" or not {"x", "y", "z"} <= set(names):
        raise ValueError("its first element is not that of vertices with x, y, z.")
    if header.form == "ascii":
        return _ascii_ply_points(path, header, [names.index(axis) for axis in "xyz"])
    vertices = read_ply_vertices(path)
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _ascii_ply_points(path: Path, header: PlyHeader, columns: list[int]) -> NDArray[np.float64]:
    text = read_bytes(path, _MOST_TEXT_BYTES)[header.length :].decode("latin-1")
    points = _columns(text, columns, header.elements[0][1])
    if len(points) < header.elements[0][1]:
        raise ValueError("it ends before its last vertex.")
    return points


def _xyz_points(path: Path) -> NDArray[np.float64]:
    return _columns(read_bytes(path, _MOST_TEXT_BYTES).decode("utf-8-sig"), [0, 1, 2])


def _columns(text: str, columns: list[int], most: int | None = None) -> NDArray[np.float64]:
    """(L, 3) numbers in three columns of the first ``most`` lines that are not empty. Raises ValueError."""
    values, last = array("d"), max(columns)
    for line in text.splitlines():
        if most is not None and len(values) >= 3 * most:
            break
        words = line.split(maxsplit=last + 1)
        if not words or words[0].startswith("#"):
            continue
        if len(words) <= last:
            raise ValueError("a line holds too few numbers.")
        values.extend([float(words[column]) for column in columns])
    return np.array(values, np.float64).reshape(-1, 3)


def _pcd_points(path: Path) -> NDArray[np.float64]:
    import open3d as o3d

    _check_pcd(path)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(str(path), format="pcd", remove_nan_points=True, remove_infinite_points=True)
    return np.asarray(cloud.points, np.float64).reshape(-1, 3)


def _check_pcd(path: Path) -> None:
    """Raise ValueError unless the header's counts fit the file's size."""
    with open_regular(path) as stream:
        head = stream.read(_LONGEST_HEADER)
        size = stream.seek(0, 2)
    text, found, after = head.partition(b"\nDATA ")
    form, newline, body = after.partition(b"\n")
    fields: dict[str, list[str]] = {}
    for line in text.decode("latin-1").splitlines():
        name, *words = line.split() or ["#"]
        fields.setdefault(name, words)
    names, sizes = fields.get("FIELDS", []), [int(word) for word in fields.get("SIZE", [])]
    counts = [int(word) for word in fields.get("COUNT", ["1"] * len(names))]
    width, height, points = (int((fields.get(name) or ["-1"])[0]) for name in ("WIDTH", "HEIGHT", "POINTS"))
    if not found or not newline or not len(names) == len(sizes) == len(counts) == len(fields.get("TYPE", [])):
        raise ValueError("its header is not that of a PCD file.")
    if (
        not {"x", "y", "z"} <= set(names)
        or not all(0 < one <= 8 for one in sizes)
        or not all(0 < one <= 4096 for one in counts)
    ):
        raise ValueError("its header states fields that are not possible.")
    record = sum(one * count for one, count in zip(sizes, counts, strict=True))
    start = len(head) - len(body)
    form = form.strip()
    least = {b"ascii": 2 * sum(counts) * points, b"binary": record * points, b"binary_compressed": 8}.get(form)
    if least is None or points < 1 or points != width * height or points * record > _MOST_BYTES:
        raise ValueError("its header states numbers of points that are not possible.")
    if size - start < least:
        raise ValueError("its header states more points than the file has bytes for.")
    if form == b"ascii":
        last = [sum(counts[: names.index(axis)]) for axis in "xyz"]
        text_lines = read_bytes(path, _MOST_TEXT_BYTES)[start:].decode("latin-1")
        if len(_columns(text_lines, last, points)) < points:
            raise ValueError("it ends before its last point.")
    if form == b"binary_compressed":
        packed, unpacked = int.from_bytes(body[:4], "little"), int.from_bytes(body[4:8], "little")
        if unpacked != points * record or packed > size - start - 8:
            raise ValueError("its header states more data than the file has.")
