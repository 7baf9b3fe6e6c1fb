"""Compares given poses with the depth that they come with, and finds the change under which the two would agree.

Depth alone measures the motion between the two frames of some pairs. Poses in the wrong form (inverted, in other units,
of other axes, of the robot's body) predict other motions. Each usual change is tried; the one under which most pairs
agree names the cause.

Source of the constant offset: F. Park, B. Martin, Robot Sensor Calibration: Solving AX = XB on the Euclidean Group,
IEEE Transactions on Robotics and Automation, 1994.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.errors import TrackingError
from ..core.transforms import invert, quats_to_rotations, rotations_to_quats
from ..core.warnings import Notice
from .rgbd.measured_pairs import MeasuredPair

Poses = NDArray[np.float64]

_POINTS = 48
"""Number of surface points of a frame whose motion is compared."""

_MOVED_M = (0.1, 0.05)
"""Smallest motion of a pair's surface points, meters, that is compared; the second if too few pairs have the first."""

_LEAST_PAIRS = 6
"""Smallest number of pairs that says anything."""

_OFF_SHARE, _OFF_M = 0.3, 0.04
"""A predicted motion agrees if it differs from the measured one by less than this share of it, or by fewer meters."""

_RIGHT, _EXPLAINED, _WRONG = 0.7, 0.7, 0.25
"""Shares of agreeing pairs: with more than the first, poses are right; a change explains them with more than the
second; without such a change, they are wrong with fewer than the third."""

_GAIN = 0.2
"""Smallest increase of the share of agreeing pairs by a change that explains wrong poses."""

_CLEARLY = 0.6
"""A less simple change must bring the median difference below this share of that of a simpler one."""

_USUAL_UNITS = {0.01: "centimeters", 0.001: "millimeters", 0.0254: "inches", 0.3048: "feet", 1000.0: "kilometers"}
_SAME_UNIT = 0.15
"""Largest relative difference of a measured unit from a usual one."""

_APART_M = 0.05
"""Frames that are nearer to each other tell no unit, meters."""

_LEAST_UNITS = 12
"""Smallest number of pairs that tells another unit of poses that agree; the pairs of a short walk share their error."""

_SURE_UNIT = 0.3
"""Largest spread of the middle half of the pairs' units, as a share of their median, that tells a unit."""

_OPENGL = np.diag((1.0, -1.0, -1.0))
_ROBOT = np.array(((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))
_LEAST_TURN_DEG, _LEAST_SPREAD = 2.0, 0.004
"""Turns of pairs that tell a constant rotation offset, and the smallest share of their squares about a second axis."""

_SHIFTS = (1, -1, 2, -2, 3, -3, 5, -5, 10, -10, 30, -30)


@dataclass(frozen=True)
class PoseAgreement:
    """How well poses agree with depth. pairs: number of compared pairs.  agreeing: of them.  change: words for the
    change under which ``explained`` pairs would agree, or agree better; empty if none is found, or none is needed."""

    pairs: int
    agreeing: int
    change: str = ""
    explained: int = 0

    @property
    def right(self) -> bool:
        """Whether nothing speaks against the poses: they agree, or too little can be compared."""
        return self.pairs < _LEAST_PAIRS or (self.agreeing >= _RIGHT * self.pairs and not self.change)

    @property
    def wrong(self) -> bool:
        """Whether the poses cannot be right."""
        return not self.right and (bool(self.change) or self.agreeing < _WRONG * self.pairs)


def check_poses(T_world_cam: Poses, pairs: Sequence[MeasuredPair], source: str) -> Notice | None:
    """Compare (N, 4, 4) given poses of a capture's frames, NaN = none, with measured pairs. source: where the poses
    come from, for messages. Returns a warning if they are doubtful. Raises TrackingError if they are wrong."""
    found = compare_poses(T_world_cam, pairs)
    if found.right:
        return None
    said = f"The poses of {source} do not agree with the depth: {found.agreeing} of {found.pairs} pairs of frames do"
    if found.change:
        said += f". {found.explained} would {found.change}"
    if found.agreeing >= _RIGHT * found.pairs:
        said = (
            f"The poses of {source} do not agree with the depth: {found.explained} of {found.pairs} pairs of frames "
            f"would agree better {found.change}"
        )
    if found.wrong:
        advice = "Correct the poses" if found.change else "Check that the poses belong to this capture"
        raise TrackingError(f"{said}. {advice}, or let them be estimated from the depth with tracking.backend=rgbd.")
    return Notice("poses-doubtful", f"{said}. The map may be blurred.")


def compare_poses(T_world_cam: Poses, pairs: Sequence[MeasuredPair]) -> PoseAgreement:
    """Compare (N, 4, 4) poses with measured pairs, and look for a change that explains wrong ones."""
    motions = _comparable(T_world_cam, pairs)
    if motions is None:
        return PoseAgreement(0, 0)
    total, given = motions.count, T_world_cam
    predicted = motions.predicted(given)
    agreeing = int((motions.errors(predicted) < 1).sum())
    if agreeing >= _RIGHT * total:
        unit = _other_unit(predicted, motions)
        return PoseAgreement(total, agreeing, _sentence("", unit), agreeing) if unit else PoseAgreement(total, agreeing)
    best, least = PoseAgreement(total, agreeing), np.inf
    for words, changed in _changes(given, motions):
        for unit, scaled in ((1.0, changed), *_in_other_units(changed, motions)):
            errors = motions.errors(scaled)
            explained, error = int((errors < 1).sum()), float(np.median(errors))
            enough = explained >= max(_EXPLAINED * total, agreeing + _GAIN * total, best.explained)
            if enough and error < _CLEARLY * least:
                best, least = PoseAgreement(total, agreeing, _sentence(words, unit), explained), error
    return best


@dataclass(frozen=True)
class _Motions:
    """K measured motions. rows: (K, 2) source and target frames.  T: (K, 4, 4) T_target_source.  points: (K, P, 3) of
    the source, meters.  moved: (K,) root mean square motion of the points."""

    rows: NDArray[np.int64]
    T: Poses
    points: NDArray[np.float64]
    moved: NDArray[np.float64]

    @property
    def count(self) -> int:
        return len(self.rows)

    def predicted(self, T_world_cam: Poses) -> Poses:
        """(K, 4, 4) T_target_source by the poses."""
        return np.asarray(invert(T_world_cam[self.rows[:, 1]]) @ T_world_cam[self.rows[:, 0]])

    def errors(self, predicted: Poses) -> NDArray[np.float64]:
        """(K,) differences of (K, 4, 4) predicted motions from the measured ones; those below 1 agree."""
        off = _apply(predicted, self.points) - _apply(self.T, self.points)
        off_m = np.sqrt((off**2).sum(axis=2).mean(axis=1))
        return np.asarray(off_m / np.maximum(_OFF_SHARE * self.moved, _OFF_M))


def _apply(T: Poses, points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(points @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3])


def _comparable(T_world_cam: Poses, pairs: Sequence[MeasuredPair]) -> _Motions | None:
    """The pairs with poses and enough motion; None if there are too few."""
    known = set(np.flatnonzero(np.isfinite(T_world_cam).all(axis=(1, 2))).tolist())
    posed = [pair for pair in pairs if {pair.source_index, pair.target_index} <= known]
    sampled = [(pair, points) for pair in posed if len(points := _sample_points(pair)) == _POINTS]
    if not sampled:
        return None
    T = np.stack([pair.T_target_source for pair, _ in sampled])
    points = np.stack([points for _, points in sampled])
    moved = np.sqrt(((_apply(T, points) - points) ** 2).sum(axis=2).mean(axis=1))
    rows = np.array([(pair.source_index, pair.target_index) for pair, _ in sampled])
    for least in _MOVED_M:
        far = np.greater_equal(moved, least)
        if far.sum() >= _LEAST_PAIRS:
            return _Motions(rows[far], T[far], points[far], moved[far])
    return None


def _sample_points(pair: MeasuredPair) -> NDArray[np.float64]:
    """(P, 3) points of the source's surface, meters, evenly chosen."""
    points = pair.source.overlap.points
    if len(points) < _POINTS:
        return np.zeros((0, 3))
    return np.asarray(points[np.linspace(0, len(points) - 1, _POINTS).astype(int)], np.float64)


def _units(predicted: Poses, motions: _Motions) -> NDArray[np.float64]:
    """Meters per unit of the predicted translations by each pair whose frames are apart."""
    center = motions.points.mean(axis=1)
    wanted = (motions.T[:, :3, :3] @ center[..., None])[..., 0] + motions.T[:, :3, 3]
    wanted = wanted - (predicted[:, :3, :3] @ center[..., None])[..., 0]
    stated = predicted[:, :3, 3]
    squared = (stated**2).sum(axis=1)
    far = (np.linalg.norm(wanted, axis=1) > _APART_M) & (squared > 1e-4 * squared.max(initial=0))
    return np.asarray((wanted * stated).sum(axis=1)[far] / squared[far])


def _in_other_units(predicted: Poses, motions: _Motions) -> Iterator[tuple[float, Poses]]:
    """The predicted motions with the unit of their translations that depth suggests, meters, if it is another one."""
    units = _units(predicted, motions)
    unit = float(np.median(units)) if len(units) else 1.0
    if unit > 0 and not 1 / 1.1 < unit < 1.1:
        unit = _usual_unit(unit)
        scaled = predicted.copy()
        scaled[:, :3, 3] *= unit
        yield unit, scaled


def _other_unit(predicted: Poses, motions: _Motions) -> float:
    """Meters per unit of the translations, if the pairs agree on another one; 0 if they do not. Turns may dominate the
    motion, so that poses in slightly other units agree well enough otherwise."""
    units = _units(predicted, motions)
    if len(units) < _LEAST_UNITS:
        return 0.0
    low, unit, high = np.quantile(units, (0.25, 0.5, 0.75))
    other = unit > 0 and high - low < _SURE_UNIT * unit and abs(np.log(unit)) > np.log(1 + _SAME_UNIT)
    return _usual_unit(float(unit)) if other else 0.0


def _usual_unit(unit: float) -> float:
    """The usual unit that a measured one is, meters; else the measured one."""
    return next((usual for usual in _USUAL_UNITS if abs(unit / usual - 1) < _SAME_UNIT), unit)


def _changes(given: Poses, motions: _Motions) -> Iterator[tuple[str, Poses]]:
    """Usual changes of poses, the simplest first: words that end "N would …", and the motions that result."""
    forms: list[tuple[str, Callable[[Poses], Poses]]] = [
        ("", lambda T: T),
        ("if they were inverted: they are world-to-camera, and must be camera-to-world", invert),
        ("if their quaternions were w x y z and not x y z w", lambda T: _reorder_quaternion(T, -1)),
        ("if their quaternions were x y z w and not w x y z", lambda T: _reorder_quaternion(T, 1)),
        ("if the rotations alone were inverted", _invert_rotation),
    ]
    predicted = [(words, motions.predicted(form(given))) for words, form in forms]
    yield from predicted
    for axes, (words, motion) in itertools.product(_axes(), predicted):
        yield _joined(words, axes[0]), _in_axes(motion, axes[1])
    for words, motion in predicted[:2]:
        yield from _with_offset(words, motion, motions)
    for shift in _SHIFTS:
        yield (
            f"if each frame had the pose {abs(shift)} frames {'later' if shift > 0 else 'earlier'}",
            motions.predicted(np.roll(given, -shift, axis=0)),
        )


def _axes() -> list[tuple[str, NDArray[np.float64]]]:
    """Words and (3, 3) matrices of all other axes that a camera may have, the usual ones first. Columns: the camera's
    x, y and z axes in the stated ones; a determinant of -1 means left-handed."""
    found = [
        ("if the camera's axes were OpenGL's (y up, looking along -z)", _OPENGL),
        ("if the camera's axes were a robot's (x forward, y left, z up)", _ROBOT),
    ]
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[list(order), range(3)] = signs
            if any(np.array_equal(matrix, known) for _, known in found) or np.array_equal(matrix, np.eye(3)):
                continue
            found.append((_describe_axes(matrix), matrix))
    return sorted(found, key=lambda axes: np.linalg.det(axes[1]) < 0)


def _describe_axes(matrix: NDArray[np.float64]) -> str:
    right, down, forward = (_axis_name(column) for column in matrix.T)
    if np.linalg.det(matrix) < 0:
        return f"if they were of a left-handed world (the camera's right is {right}, down {down}, forward {forward})"
    return f"if the camera's axes were others (right is {right}, down {down}, forward {forward})"


def _axis_name(column: NDArray[np.float64]) -> str:
    axis = int(np.abs(column).argmax())
    return f"{'-' if column[axis] < 0 else '+'}{'xyz'[axis]}"


def _in_axes(motion: Poses, axes: NDArray[np.float64]) -> Poses:
    """Motions (K, 4, 4) in stated axes as motions in camera axes."""
    changed = motion.copy()
    changed[:, :3, :3] = axes.T @ motion[:, :3, :3] @ axes
    changed[:, :3, 3] = motion[:, :3, 3] @ axes
    return changed


def _reorder_quaternion(T: Poses, step: int) -> Poses:
    """Poses whose quaternion was read with w last but has it first (-1), or the other way (1)."""
    changed = T.copy()
    changed[:, :3, :3] = quats_to_rotations(np.roll(rotations_to_quats(T[:, :3, :3]), step, axis=1))
    return changed


def _invert_rotation(T: Poses) -> Poses:
    changed = T.copy()
    changed[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    return changed


def _with_offset(words: str, predicted: Poses, motions: _Motions) -> Iterator[tuple[str, Poses]]:
    """The motions of a camera at a constant place on the body whose motions are predicted: A X = X B."""
    turns, seen = _rotation_vectors(predicted), _rotation_vectors(motions.T)
    angle = np.linalg.norm(turns, axis=1)
    alike = (angle > np.radians(_LEAST_TURN_DEG)) & (np.abs(angle - np.linalg.norm(seen, axis=1)) < 0.2 * angle)
    if alike.sum() < _LEAST_PAIRS:
        return
    u, spread, vt = np.linalg.svd(turns[alike].T @ seen[alike])
    if spread[1] < _LEAST_SPREAD * spread[0]:
        return
    X = np.eye(4)
    X[:3, :3] = u @ np.diag((1.0, 1.0, np.linalg.det(u @ vt))) @ vt
    left = (predicted[alike, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (motions.T[alike, :3, 3] @ X[:3, :3].T - predicted[alike, :3, 3]).reshape(-1)
    X[:3, 3] = np.linalg.lstsq(left, right, rcond=None)[0]
    degrees = np.degrees(np.linalg.norm(_rotation_vectors(X[None])))
    place = ", ".join(f"{value:.2f}" for value in X[:3, 3])
    offset = f"if the camera were {place} m and {degrees:.0f} degrees from the body whose poses they are"
    yield _joined(words, offset), np.asarray(invert(X) @ predicted @ X)


def _rotation_vectors(T: Poses) -> NDArray[np.float64]:
    """(K, 3) axis times angle, radians, of the rotations of (K, 4, 4) poses."""
    quats = rotations_to_quats(T[:, :3, :3])
    quats = np.where(quats[:, :1] < 0, -quats, quats)
    sine = np.linalg.norm(quats[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, quats[:, 0])
    return np.asarray(quats[:, 1:] * (angle / np.maximum(sine, 1e-12))[:, None])


def _joined(first: str, second: str) -> str:
    return f"{first}, and {second}" if first else second


def _sentence(words: str, unit: float) -> str:
    if unit == 1:
        return words
    name = f" ({_USUAL_UNITS[unit]})" if unit in _USUAL_UNITS else ""
    return _joined(words, f"if a unit of their positions were {unit:.3g} m{name}")
