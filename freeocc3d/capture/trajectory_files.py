"""Reads trajectory files of other systems, and assigns their poses to the frames of a capture.

All formats become camera-to-world poses in OpenCV axes. A pose is matched by its time (TUM), by the name of its image
(COLMAP, nerfstudio, 7-Scenes), or by its position in the file (KITTI, Replica, Open3D's .log).

Sources: J. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012 (TUM's form, association by
time); A. Geiger et al., KITTI's odometry development kit; the format pages of COLMAP, nerfstudio and Open3D.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import tum_files
from ..core.errors import CaptureError
from ..core.regular_files import user_path
from ..core.transforms import invert, is_rigid
from .base import Capture
from .camera_files import FARTHEST, read_matrix
from .colmap_models import colmap_folder, read_colmap_model
from .nerfstudio_files import read_transforms
from .number_files import NumberRows, read_number_rows
from .numbered_files import list_folder

SAME_TIME_S = 0.02
"""Largest difference of timestamps that match, as in the TUM RGB-D benchmark."""

FORMS = (
    "TUM (timestamp, position, quaternion xyzw), KITTI or Replica (12 or 16 numbers per line), Open3D's .log, "
    "COLMAP's images.txt or images.bin, nerfstudio's transforms.json, or a folder of 7-Scenes' *.pose.txt"
)
"""The supported formats, in words."""

_MOST_POSES = 1_000_000
_LATEST = 1e12
"""Largest time of a pose, seconds."""


@dataclass(frozen=True)
class PoseFile:
    """The M poses of a file.

    T_world_cam: (M, 4, 4); NaN where the file has none.  timestamps: (M,) seconds, or None.
    names: M image names, or empty.
    """

    path: Path
    T_world_cam: NDArray[np.float64]
    timestamps: NDArray[np.float64] | None = None
    names: tuple[str, ...] = ()

    def times(self) -> NDArray[np.float64]:
        """(M,) seconds. Without times, the number in the image's name or the position in the file; captures without
        times count the same way."""
        if self.timestamps is not None:
            return self.timestamps
        numbers = [_number(name) for name in self.names]
        if numbers and all(numbers):
            return np.array([float(number[-18:]) for number in numbers])
        return np.arange(len(self.T_world_cam), dtype=np.float64)

    def of_frames(self, capture: Capture, tolerance_s: float = SAME_TIME_S) -> NDArray[np.float64]:
        """(N, 4, 4) poses of a capture's N frames; NaN where the file has none.

        Images match by name, else by the number in the name; times match the nearest within the tolerance, seconds.
        Raises CaptureError if nothing matches.
        """
        T = np.full((len(capture), 4, 4), np.nan)
        if self.names:
            rows = _by_name(self.names, [capture.name(index) for index in range(len(capture))])
        elif self.timestamps is not None:
            order = np.argsort(self.timestamps, kind="stable")
            own, frames = associate(self.timestamps[order], capture.timestamps, tolerance_s)
            rows = dict(zip(frames.tolist(), order[own].tolist(), strict=True))
        else:
            rows = {index: index for index in range(min(len(T), len(self.T_world_cam)))}
        for frame, row in rows.items():
            T[frame] = self.T_world_cam[row]
        if not np.isfinite(T).any():
            raise CaptureError(f"No pose of {self.path} matches a frame of {capture.path}: {self._mismatch(capture)}.")
        return T

    def _mismatch(self, capture: Capture) -> str:
        if self.names:
            return f"its first image is {self.names[0]}, the capture's {capture.name(0) or 'has no name'}"
        if self.timestamps is not None and len(self.timestamps):
            a, b = self.timestamps, capture.timestamps
            return f"its times are {a.min():.2f} to {a.max():.2f} s, the capture's {b[0]:.2f} to {b[-1]:.2f} s"
        return "it states none"


def read_trajectory(path: str | Path) -> PoseFile:
    """Read a file in any of ``FORMS``. Raises CaptureError for any other file, or a damaged one."""
    path = user_path(path)
    if path.is_dir():
        return _read_folder(path)
    if not os.path.exists(path):
        raise CaptureError(f"There is no trajectory {path}: check the path.")
    if path.name in ("images.txt", "images.bin"):
        return _read_colmap(path.parent)
    return _read_nerfstudio(path) if path.suffix == ".json" else _read_text(path)


def _checked(found: PoseFile) -> PoseFile:
    finite = np.isfinite(found.T_world_cam).all(axis=(1, 2))
    if not finite.any():
        raise CaptureError(f"{found.path} is not a trajectory: it holds no pose.")
    if np.isfinite(found.T_world_cam[~finite, :3]).any():
        raise CaptureError(
            f"{found.path} holds a pose of which some numbers are NaN or infinite: correct or remove it."
        )
    if (np.abs(found.T_world_cam[finite, :3, 3]) > FARTHEST).any():
        raise CaptureError(f"{found.path} holds a position that is not possible: correct it.")
    if not all(is_rigid(pose) for pose in found.T_world_cam[finite]):
        raise CaptureError(f"{found.path} holds a matrix that is not a rigid camera-to-world pose.")
    return found


def _read_folder(folder: Path) -> PoseFile:
    if files := [folder / name for name in list_folder(folder) if name.endswith(".pose.txt")]:
        T = np.stack([_read_pose(file) for file in files])
        return _checked(PoseFile(folder, T, names=tuple(file.name for file in files)))
    if model := colmap_folder(folder):
        return _read_colmap(model)
    if (folder / "transforms.json").is_file():
        return _read_nerfstudio(folder / "transforms.json")
    raise CaptureError(f"{folder} holds no trajectory: expected {FORMS}.")


def _read_pose(path: Path) -> NDArray[np.float64]:
    """A (4, 4) matrix; NaN if it holds no numbers, as where tracking was lost. Raises CaptureError."""
    matrix = read_matrix(path)
    if matrix is None or matrix.shape != (4, 4):
        raise CaptureError(f"{path} must hold a pose of 4 x 4 numbers: correct or remove it.")
    return matrix if np.isfinite(matrix).all() else np.full((4, 4), np.nan)


def _read_text(path: Path) -> PoseFile:
    try:
        rows = read_number_rows(path)
        table = rows.table()
        if table is not None and table.shape[1] == tum_files.NUMBERS:
            timestamps, T = tum_files.tum_poses(table)
            if (np.abs(timestamps) > _LATEST).any():
                raise ValueError("a time is out of range")
            found = PoseFile(path, T, timestamps)
        elif table is not None and table.shape[1] in (12, 16):
            T = np.tile(np.eye(4), (len(table), 1, 1))
            T[:, : table.shape[1] // 4] = table.reshape(len(table), -1, 4)
            found = PoseFile(path, T)
        else:
            found = _read_log(path, rows)
    except ValueError as error:
        raise CaptureError(f"{path} is not a trajectory: expected {FORMS}.") from error
    return _checked(found)


def _read_log(path: Path, rows: NumberRows) -> PoseFile:
    """Read Open3D's .log: per pose a line of three numbers, first the frame number, then four lines of the matrix."""
    count = len(rows.lengths) // 5
    if not count or not np.array_equal(rows.lengths, np.tile((3, 4, 4, 4, 4), count)):
        raise ValueError("no log")
    blocks = rows.values.reshape(count, 3 + 16)
    numbers = blocks[:, 0]
    if not ((numbers >= 0) & (numbers < _MOST_POSES)).all():
        raise ValueError("a frame number is out of range")
    T = np.full((int(numbers.max()) + 1, 4, 4), np.nan)
    T[numbers.astype(np.int64)] = blocks[:, 3:].reshape(count, 4, 4)
    return PoseFile(path, T)


def _read_nerfstudio(path: Path) -> PoseFile:
    content = read_transforms(path)
    names = tuple(Path(frame.file_path).name for frame in content.frames)
    return _checked(PoseFile(path, content.poses(), names=names))


def _read_colmap(folder: Path) -> PoseFile:
    model = read_colmap_model(folder)
    images = sorted(model.images, key=lambda image: image.name)
    if not images:
        raise CaptureError(f"The COLMAP model {folder} holds no image with a pose: check the reconstruction.")
    T_cam_world = np.stack([image.T_cam_world for image in images])
    return _checked(PoseFile(folder, invert(T_cam_world), names=tuple(Path(image.name).name for image in images)))


def _by_name(names: tuple[str, ...], frames: list[str]) -> dict[int, int]:
    """Frame -> row of the pose with the same image name or, if no name matches, with the same last number."""
    for key in (str, _stem, _number):
        rows = {key(name): row for row, name in enumerate(names)}
        found = {frame: rows[key(name)] for frame, name in enumerate(frames) if name and key(name) in rows}
        if found and "" not in rows:
            return found
    return {}


def _stem(name: str) -> str:
    return name.split(".")[0] if not re.match(r"\d+\.\d+\.", name) else name.rsplit(".", 1)[0]


def _number(name: str) -> str:
    digits = re.findall(r"\d+", _stem(name))
    return digits[-1].lstrip("0") or "0" if digits else ""


def associate(
    times_a: NDArray[np.float64], times_b: NDArray[np.float64], tolerance_s: float = SAME_TIME_S
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Matching rows of two ascending lists of timestamps: each entry of the shorter list with the nearest entry of the
    longer one, if they differ by at most the tolerance."""
    if len(times_a) > len(times_b):
        rows_b, rows_a = associate(times_b, times_a, tolerance_s)
        return rows_a, rows_b
    if not len(times_a):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    after = np.clip(np.searchsorted(times_b, times_a), 1, max(len(times_b) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times_b) - 1)
    nearest = np.where(np.abs(times_b[after] - times_a) < np.abs(times_b[before] - times_a), after, before)
    close = np.abs(times_b[nearest] - times_a) <= tolerance_s
    return np.flatnonzero(close), nearest[close]
