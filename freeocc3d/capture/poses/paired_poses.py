"""Finds the poses that files beside the images of a capture state, and gives each frame its own."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.transforms import quats_to_rotations, rotations_to_quats
from ..cameras.camera_files import check_pose_files, is_pose, read_pose
from ..files.name_matching import SAME_TIME_S, match_names
from ..files.numbered_files import list_folder
from ..files.paired_folders import PairList, list_images
from .trajectory_files import PoseFile

MOST_BETWEEN_S = 0.1
"""Poses are interpolated between neighbors that are both within this many seconds."""

_EXACT_S = 1e-6
_MOST_POSES = 1_000_000
_POSE_FILES = tuple(
    re.compile(pattern, re.IGNORECASE)
    for pattern in (
        r"ground_?truth\.(?:txt|csv|tum)",
        r"(?:.*[\W_])?gt\.(?:txt|tum|freiburg)",
        r"(?:camera_?)?traj(?:ectory|ectories)?\.(?:txt|log|tum)",
        r"(?:camera_?)?poses?\.(?:txt|log|tum)",
        r".*\.log",
    )
)


def find_pose_file(folder: Path) -> Path | None:
    """The file of poses of a capture, by its usual names: the true ones first; None if there is none."""
    names = [name for name in list_folder(folder) if not name.startswith(".")]
    for pattern in _POSE_FILES:
        if found := [name for name in names if pattern.fullmatch(name)]:
            return folder / found[0]
    return None


def read_pose_folder(folder: Path, frames: PairList) -> list[NDArray[np.float64] | None]:
    """The poses of a folder of a 4 x 4 matrix per frame, matched by the numbers in the names; None where there is none.
    Raises CaptureError if none matches, or a file cannot be read."""
    names = list_images(folder, {".txt"})
    own = [pair.color.name for pair in frames.pairs]
    found = match_names(own, names)
    if not found.first:
        raise CaptureError(f"No pose of {folder} has the number of a color image: the first is {names[0]}.")
    files = dict(zip(found.first, found.second, strict=True))
    check_pose_files([folder / names[row] for row in found.second], str(folder))
    return [read_pose(folder / names[files[row]]) if row in files else None for row in range(len(own))]


def assign_poses(poses: PoseFile, frames: PairList) -> NDArray[np.float64]:
    """(N, 4, 4) poses of the frames; NaN where the file has none. Poses match by the name of an image, by their time,
    by the number of the frame, or by their order. Raises CaptureError if none matches."""
    if poses.names:
        found = match_names([pair.color.name for pair in frames.pairs], poses.names, by_time=False)
        return _taken(poses.T_world_cam, dict(zip(found.first, found.second, strict=True)), len(frames.pairs))
    T_world_cam = poses.T_world_cam
    if poses.timestamps is not None and frames.has_times:
        times = np.array([pair.time for pair in frames.pairs])
        T = interpolate_poses(poses.timestamps, T_world_cam, times)
        if np.isfinite(T).any():
            return T
    keys = poses.timestamps if poses.numbers is None else poses.numbers
    if keys is not None:
        rows = {float(key): row for row, key in enumerate(keys.tolist())}
        numbers = [pair.number for pair in frames.pairs]
        own = {i: rows[number] for i, number in enumerate(numbers) if number is not None and number in rows}
        if own and (poses.numbers is None or len(own) == len(numbers)):
            return _taken(T_world_cam, own, len(frames.pairs))
    if poses.numbers is not None and (largest := int(poses.numbers.max())) < _MOST_POSES and poses.numbers.min() >= 0:
        by_number = {number: row for row, number in enumerate(poses.numbers.tolist())}
        T_world_cam = _taken(T_world_cam, by_number, largest + 1)
    rows_by_order = _rows_in_order(len(T_world_cam), frames)
    if rows_by_order is None:
        raise CaptureError(
            f"{poses.path} holds {len(T_world_cam)} poses for {len(frames.pairs)} frames, and neither their "
            "times nor their numbers agree: correct or remove it."
        )
    return _taken(T_world_cam, dict(enumerate(rows_by_order)), len(frames.pairs))


def interpolate_poses(
    times: NDArray[np.float64], T_world_cam: NDArray[np.float64], wanted: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 4, 4) poses at ``wanted`` (N,) from (M, 4, 4) poses at ``times`` (M,); NaN where there is none near.

    Positions are interpolated linearly and rotations on the great circle between neighbors within ``MOST_BETWEEN_S``.
    Elsewhere the nearest within ``SAME_TIME_S`` counts.
    """
    order = np.argsort(times, kind="stable")
    times, T = times[order], T_world_cam[order]
    after = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    before = np.where(times[after] > wanted, np.maximum(after - 1, 0), after)
    to_before, to_after = np.abs(wanted - times[before]), np.abs(times[after] - wanted)
    nearest = np.where(to_before <= to_after, before, after)
    out = np.where((np.minimum(to_before, to_after) <= SAME_TIME_S)[:, None, None], T[nearest], np.nan)
    between = (before != after) & (np.maximum(to_before, to_after) <= MOST_BETWEEN_S)
    between &= np.minimum(to_before, to_after) > _EXACT_S
    a, b = before[between], after[between]
    if len(a):
        share = (wanted[between] - times[a]) / (times[b] - times[a])
        out[between] = _blend(T[a], T[b], share)
    return np.asarray(out)


def _blend(T_a: NDArray[np.float64], T_b: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 4, 4) poses between two of each, at a share (K,) of the way; NaN where one is."""
    finite = np.isfinite(T_a).all(axis=(1, 2)) & np.isfinite(T_b).all(axis=(1, 2))
    out = np.full_like(T_a, np.nan)
    T_a, T_b, share = T_a[finite], T_b[finite], share[finite][:, None]
    qa, qb = rotations_to_quats(T_a[:, :3, :3]), rotations_to_quats(T_b[:, :3, :3])
    cosine = (qa * qb).sum(axis=1, keepdims=True)
    qb, cosine = np.where(cosine < 0, -qb, qb), np.abs(cosine).clip(max=1.0)
    angle = np.arccos(cosine)
    small = angle < 1e-6
    sine = np.where(small, 1.0, np.sin(angle))
    wa = np.where(small, 1 - share, np.sin((1 - share) * angle) / sine)
    wb = np.where(small, share, np.sin(share * angle) / sine)
    mixed = wa * qa + wb * qb
    T = np.tile(np.eye(4), (len(T_a), 1, 1))
    T[:, :3, :3] = quats_to_rotations(mixed / np.linalg.norm(mixed, axis=1, keepdims=True))
    T[:, :3, 3] = (1 - share) * T_a[:, :3, 3] + share * T_b[:, :3, 3]
    out[finite] = T
    return out


def _rows_in_order(count: int, frames: PairList) -> Sequence[int] | None:
    """The row of each frame in a list of ``count`` poses without times: all color images in order, the frames in order,
    or by number; None if the count fits none."""
    numbers = [pair.number for pair in frames.pairs]
    if count == frames.colors:
        return [pair.row for pair in frames.pairs]
    if count == len(frames.pairs):
        return range(count)
    known = [number for number in numbers if number is not None]
    if len(known) == len(numbers):
        if min(known) >= 1 and max(known) == count:
            return [number - 1 for number in known]
        if max(known) < count:
            return known
    return None


def _taken(T: NDArray[np.float64], rows: dict[int, int], frames: int) -> NDArray[np.float64]:
    out = np.full((frames, 4, 4), np.nan)
    for frame, row in rows.items():
        out[frame] = T[row]
    return out


def usable_pose(T: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """A (4, 4) pose, or None if it is none."""
    return T if is_pose(T) else None
