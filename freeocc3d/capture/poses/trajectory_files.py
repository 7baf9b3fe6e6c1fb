"""Reads trajectory files of other systems, and assigns their poses to the frames of a capture.

All formats become camera-to-world poses in OpenCV axes. A pose is matched by its time (TUM), by the name of its image
(COLMAP, nerfstudio, 7-Scenes), by a frame number, or by its position in the file (KITTI, Replica, Open3D's .log).

Sources: J. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012 (TUM's form, association by
time); A. Geiger et al., KITTI's odometry development kit; the format pages of COLMAP, nerfstudio and Open3D.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.regular_files import user_path
from ...core.transforms import invert, is_rigid
from ...core.warnings import Notice
from ..base import Capture
from ..cameras.camera_files import FARTHEST, explain_no_pose, read_matrix
from ..files.file_finding import last_part
from ..files.number_files import read_number_rows
from ..files.numbered_files import list_folder
from .colmap_models import read_colmap_model
from .colmap_projects import colmap_folder
from .nerfstudio_files import Transforms, read_transforms
from .pose_tables import UNITS, read_pose_table

SAME_TIME_S = 0.02
"""Largest difference of timestamps that match, as in the TUM RGB-D benchmark."""

FORMS = (
    "TUM (timestamp, position, quaternion xyzw), a table whose heading names such columns, KITTI or Replica (12 or 16 "
    "numbers per line), Open3D's .log, COLMAP's images.txt or images.bin, nerfstudio's transforms.json, "
    "or a folder of 7-Scenes' *.pose.txt"
)
"""The supported formats, in words."""


@dataclass(frozen=True)
class PoseFile:
    """The M poses of a file.

    T_world_cam: (M, 4, 4); NaN where the file has none.  timestamps: (M,) seconds, or None.
    names: M image names, or empty.  numbers: (M,) of the frames, or None.
    """

    path: Path
    T_world_cam: NDArray[np.float64]
    timestamps: NDArray[np.float64] | None = None
    names: tuple[str, ...] = ()
    numbers: NDArray[np.int64] | None = None

    def times(self) -> NDArray[np.float64]:
        """(M,) seconds. Without times, the frame's number, that in the image's name or the position in the file;
        captures without times count the same way."""
        if self.timestamps is not None:
            return self.timestamps
        if self.numbers is not None:
            return self.numbers.astype(np.float64)
        numbers = [_number(name) for name in self.names]
        if numbers and all(numbers):
            return np.array([float(number[-18:]) for number in numbers])
        return np.arange(len(self.T_world_cam), dtype=np.float64)

    def of_frames(self, capture: Capture, tolerance_s: float = SAME_TIME_S) -> NDArray[np.float64]:
        """(N, 4, 4) poses of a capture's N frames; NaN where the file has none.

        Images match by name, else by the number in the name; times match the nearest within the tolerance, seconds,
        and are of the unit that fits more than one frame; then frame numbers match, and last positions in the file.
        Raises CaptureError if nothing matches.
        """
        T = np.full((len(capture), 4, 4), np.nan)
        if self.names:
            rows = _by_name(self.names, [capture.name(index) for index in range(len(capture))])
        elif self.timestamps is not None or self.numbers is not None:
            rows = self._by_time(capture.timestamps, tolerance_s) or self._by_number(capture)
        else:
            rows = {index: index for index in range(min(len(T), len(self.T_world_cam)))}
        for frame, row in rows.items():
            T[frame] = self.T_world_cam[row]
        if not np.isfinite(T).any():
            raise CaptureError(f"No pose of {self.path} matches a frame of {capture.path}: {self._mismatch(capture)}.")
        return T

    def report_missing(self, T_world_cam: NDArray[np.float64], frames: Sequence[int], capture: Path) -> Notice | None:
        """A warning that says how many of the frames have a pose; None if all have one.

        T_world_cam: the result of ``of_frames``.  frames: those that are used.  capture: for the message.
        """
        posed = int(np.isfinite(T_world_cam[list(frames)]).all(axis=(1, 2)).sum())
        if posed == len(frames):
            return None
        held = np.isfinite(self.T_world_cam).all(axis=(1, 2))
        none = "" if held.all() else f", and {int((~held).sum())} rows without one"
        return Notice(
            "poses-missing",
            f"{posed} of {len(frames)} frames of {capture} have a pose in {self.path}, which holds {int(held.sum())} "
            f"poses{none}; the other {len(frames) - posed} have none of their own.",
        )

    def _by_time(self, times: NDArray[np.float64], tolerance_s: float) -> dict[int, int]:
        """Frame -> row of the pose of that time. The unit is that which matches most frames, seconds if several do."""
        best: dict[int, int] = {}
        if self.timestamps is None:
            return best
        order = np.argsort(self.timestamps, kind="stable")
        for unit in (*UNITS, *(1 / unit for unit in UNITS[1:])):
            own, frames = associate(self.timestamps[order] * unit, times, tolerance_s)
            found = dict(zip(frames.tolist(), order[own].tolist(), strict=True))
            if len(set(found.values())) > max(len(best), 0 if unit == 1 else 1):
                best = found
        return best

    def _by_number(self, capture: Capture) -> dict[int, int]:
        """Frame -> row of the pose with the number in the frame's name, or of the frame's position."""
        if self.numbers is None:
            return {}
        rows = {number: row for row, number in enumerate(self.numbers.tolist())}
        named = [int(_number(capture.name(frame)) or -1) for frame in range(len(capture))]
        keys = named if len(set(named)) == len(named) else range(len(capture))
        return {frame: rows[key] for frame, key in enumerate(keys) if key in rows}

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
    wrong = [row for row in np.flatnonzero(finite).tolist() if not is_rigid(found.T_world_cam[row])]
    if wrong:
        name = f"{found.names[wrong[0]]}'s" if found.names else f"number {wrong[0] + 1}"
        be = "is not a" if len(wrong) == 1 else "are no"
        raise CaptureError(
            f"{found.path} holds {len(found.T_world_cam)} matrices, of which {len(wrong)} {be} rigid right-handed "
            f"camera-to-world pose{'s' * (len(wrong) > 1)}: {name} {explain_no_pose(found.T_world_cam[wrong[0]])}."
        )
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
        table = read_pose_table(read_number_rows(path, headed=True))
    except ValueError as error:
        raise CaptureError(f"{path} is not a trajectory: {error}. Expected {FORMS}.") from error
    return _checked(PoseFile(path, table.T_world_cam, table.times, numbers=table.numbers))


def _read_nerfstudio(path: Path) -> PoseFile:
    return poses_of_transforms(read_transforms(path), path)


def poses_of_transforms(content: Transforms, path: Path) -> PoseFile:
    """The poses of nerfstudio's file ``path``. Raises CaptureError if one is not rigid, or there is none."""
    names = tuple(last_part(frame.file_path) for frame in content.frames)
    return _checked(PoseFile(path, content.poses(), names=names))


def _read_colmap(folder: Path) -> PoseFile:
    model = read_colmap_model(folder)
    images = sorted(model.images, key=lambda image: image.name)
    if not images:
        raise CaptureError(f"The COLMAP model {folder} holds no image with a pose: check the reconstruction.")
    T_cam_world = np.stack([image.T_cam_world for image in images])
    return _checked(PoseFile(folder, invert(T_cam_world), names=tuple(last_part(image.name) for image in images)))


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
