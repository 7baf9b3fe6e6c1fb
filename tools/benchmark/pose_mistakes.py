"""Given poses against depth: how many pieces with right poses pass, and how many distorted ones are refused with the
right cause."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from freeocc3d.core.transforms import invert, quats_to_rotations, rotations_to_quats

from .figures import Figures, tabulate

PIECES, SEED = 14, 0
"""Pieces of each capture; the seed chooses where they begin, how long they are, and what is distorted how."""

MISTAKES_OF_A_PIECE = 5

_OPENGL = ((1, 0, 0), (0, -1, 0), (0, 0, -1))

Poses = NDArray[np.float64]
Mistake = tuple[str, Callable[[Poses], Poses]]
"""Words of the right cause, and the distortion of (N, 4, 4) poses."""


def measure_pose_check(capture: str) -> Figures:
    """Right pieces that pass, and distorted ones that are refused with the right cause, with another one, or not."""
    from freeocc3d.capture import open_capture
    from freeocc3d.tracking.pose_check import compare_poses
    from freeocc3d.tracking.rgbd.measured_pairs import measure_pairs

    opened, rng = open_capture(capture), np.random.default_rng(SEED)
    stated = np.stack([_or_none(opened.pose(index)) for index in range(len(opened))])
    figures: dict[str, Any] = {
        "pieces": PIECES,
        "passed": 0,
        "distorted": 0,
        "named": 0,
        "refused": 0,
        "least_agreeing": 1.0,
        "wrong": [],
    }
    measuring = comparing = 0.0
    for _ in range(PIECES):
        frames = _choose_piece(len(opened), rng)
        began = time.perf_counter()
        pairs = measure_pairs(opened, frames)
        measuring += time.perf_counter() - began
        found = compare_poses(stated, pairs)
        figures["passed"] += found.right
        figures["least_agreeing"] = min(figures["least_agreeing"], found.agreeing / max(found.pairs, 1))
        for name, (words, change) in _choose_mistakes(rng):
            began = time.perf_counter()
            found = compare_poses(change(stated), pairs)
            comparing += time.perf_counter() - began
            figures["distorted"] += 1
            figures["refused"] += found.wrong
            named = found.wrong and words in found.change
            figures["named"] += named
            if not named:
                figures["wrong"].append([str(frames), name, found.change or f"{found.agreeing} of {found.pairs} agree"])
    seconds = {"measuring": measuring / PIECES, "comparing": comparing / max(figures["distorted"], 1)}
    return {**figures, "seconds": seconds}


def tabulate_pose_check(rows: Sequence[Figures]) -> list[str]:
    """A table of all captures, then what was not named."""
    header = (
        "capture", "right, passed", "agreeing pairs of these", "distorted", "refused", "right cause (asked >= 95 %)",
        "s a piece, s a check",
    )  # fmt: skip
    table = [
        (
            row["capture"],
            f"{row['passed']} of {row['pieces']}",
            f">= {row['least_agreeing']:.0%}",
            str(row["distorted"]),
            str(row["refused"]),
            f"{row['named']} ({row['named'] / row['distorted']:.1%})",
            f"{row['seconds']['measuring']:.2f}, {row['seconds']['comparing']:.2f}",
        )
        for row in rows
    ]
    wrong = [f"- {row['capture']}, {name}, {frames}: {found}" for row in rows for frames, name, found in row["wrong"]]
    return [*tabulate(header, table), "", *wrong]


def _or_none(pose: Poses | None) -> Poses:
    return np.full((4, 4), np.nan) if pose is None else pose


def _choose_piece(count: int, rng: np.random.Generator) -> range:
    """40 to 240 frames of a capture, every one to third."""
    stride = int(rng.integers(1, 4))
    length = min(int(rng.integers(40, 241)) * stride, count)
    start = int(rng.integers(0, count - length + 1))
    return range(start, start + length, stride)


def _choose_mistakes(rng: np.random.Generator) -> list[tuple[str, Mistake]]:
    mistakes = _mistakes(rng)
    chosen = rng.choice(len(mistakes), MISTAKES_OF_A_PIECE, replace=False)
    return [list(mistakes.items())[row] for row in chosen.tolist()]


def _mistakes(rng: np.random.Generator) -> dict[str, Mistake]:
    unit, feet = float(rng.choice((0.4, 0.6, 1.6, 2.5))), 1 / 0.3048
    offset = _offset(rng)
    return {
        "inverted": ("inverted: they are world-to-camera", invert),
        "centimeters": ("0.01 m", lambda T: _scaled(T, 100)),
        "millimeters": ("0.001 m", lambda T: _scaled(T, 1000)),
        "feet": ("0.305 m", lambda T: _scaled(T, feet)),
        "an odd unit": ("a unit of their positions were", lambda T: _scaled(T, unit)),
        "OpenGL axes": ("OpenGL", lambda T: _in_axes(T, _OPENGL)),
        "robot axes": ("robot", lambda T: _in_axes(T, ((0, -1, 0), (0, 0, -1), (1, 0, 0)))),
        "axes of a turned sensor": ("axes were others", lambda T: _in_axes(T, ((0, 1, 0), (-1, 0, 0), (0, 0, 1)))),
        "a left-handed world": ("left-handed", _mirrored),
        "w first, read as last": ("w x y z and not", lambda T: _reordered(T, 1)),
        "w last, read as first": ("x y z w and not", lambda T: _reordered(T, -1)),
        "inverted, centimeters": ("inverted: they are world-to-camera", lambda T: _scaled(invert(T), 100)),
        "OpenGL axes, millimeters": (
            "OpenGL",
            lambda T: _scaled(_in_axes(T, ((1, 0, 0), (0, -1, 0), (0, 0, -1))), 1e3),
        ),
        "of the body": ("from the body", lambda T: T @ invert(offset)),
        "late by 10 frames": ("10 frames later", lambda T: np.roll(T, 10, axis=0)),
    }


def _scaled(T: Poses, factor: float) -> Poses:
    T = T.copy()
    T[:, :3, 3] *= factor
    return T


def _in_axes(T: Poses, columns: tuple[tuple[int, int, int], ...]) -> Poses:
    S = np.eye(4)
    S[:3, :3] = np.array(columns, float).T
    return np.asarray(T @ np.linalg.inv(S))


def _mirrored(T: Poses) -> Poses:
    M = np.diag([1.0, -1.0, 1.0, 1.0])
    return np.asarray(M @ T @ M)


def _reordered(T: Poses, step: int) -> Poses:
    T = T.copy()
    T[:, :3, :3] = quats_to_rotations(np.roll(rotations_to_quats(T[:, :3, :3]), step, axis=1))
    return T


def _offset(rng: np.random.Generator) -> Poses:
    """The camera on a robot: looking forward, up to 20 degrees down, up to half a meter before and a meter above."""
    down = np.radians(rng.uniform(0, 20))
    X = np.eye(4)
    X[:3, :3] = ((0, -np.sin(down), np.cos(down)), (-1, 0, 0), (0, -np.cos(down), -np.sin(down)))
    X[:3, 3] = rng.uniform(0, 0.5), rng.uniform(-0.2, 0.2), rng.uniform(0.3, 1.0)
    return X
