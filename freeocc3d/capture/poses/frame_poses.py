"""Times and poses of frames, as recordings state them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.transforms import quats_to_rotations
from ..cameras.camera_files import FARTHEST

_LATEST = 1e12
"""Largest time, seconds."""


def ascending_times(stated: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) seconds of frames in order: as stated if each is later than the one before, else 0, 1, 2, …"""
    times = np.asarray(stated, np.float64)
    usable = np.isfinite(times).all() and (np.abs(times) <= _LATEST).all() and (np.diff(times) > 0).all()
    return times if usable else np.arange(len(times), dtype=np.float64)


def poses_of(positions: ArrayLike, quats_xyzw: ArrayLike, opengl: bool) -> tuple[NDArray[np.float64] | None, ...]:
    """(4, 4) T_world_cam in OpenCV axes from (N, 3) positions, meters, and (N, 4) quaternions of any length; None where
    a number is no place or no turn.

    opengl: whether the stated cameras look along -z with y up, as those of ARKit do.
    """
    t = np.asarray(positions, np.float64).reshape(-1, 3)
    quats = np.asarray(quats_xyzw, np.float64).reshape(-1, 4)
    with np.errstate(invalid="ignore", over="ignore"):
        lengths = np.linalg.norm(quats, axis=1)
        usable = np.isfinite(t).all(axis=1) & (np.abs(t).max(axis=1) <= FARTHEST) & (lengths > 1e-6) & (lengths < 1e3)
    unit = np.where(usable[:, None], quats / np.where(usable, lengths, 1.0)[:, None], (0.0, 0.0, 0.0, 1.0))
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = quats_to_rotations(unit[:, [3, 0, 1, 2]])
    T[:, :3, 3] = t
    if opengl:
        T[:, :, 1:3] *= -1
    return tuple(pose if good else None for pose, good in zip(T, usable.tolist(), strict=True))
