"""The unit of stored depth: estimated from the scene where nothing states it, and doubted where it does not fit.

A room's depth has a usual range, but several units may bring a scan into it. Then the message names all of them, with
what each would make of the room.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ...core.sampling import spread_evenly
from ...core.warnings import Notice
from ..base import Capture
from ..images.depth_decoding import SATURATED, RawDepth
from ..rgbd_frames import RgbdFrames

UNITS = {
    1000.0: "millimeters",
    4000.0: "RealSense L515",
    5000.0: "TUM",
    6553.5: "Replica",
    10000.0: "tenths of millimeters",
    100.0: "centimeters",
    1.0: "meters",
}
"""Units per meter of known sensors and data sets, the most common first."""

MEDIAN_M = 0.3, 4.5
"""Range of the median depth of an indoor scan, meters, for a unit that is estimated."""

FAR_M = 10.0
"""Indoor scans have nine tenths of their depth nearer than this, meters."""

DOUBTFUL_MEDIAN_M = 0.1, 8.0
"""Range of the median depth that a stated unit may give, meters."""

LEAST_WITHIN = 0.5
"""Smallest share of the depth within ``capture.max_depth`` that raises no doubt."""

_TYPICAL_M = 2.0
_SAMPLES = 9
_FAR_MEDIAN_M = 3.0
_MULTIPLES = 0.99


@dataclass(frozen=True)
class DepthSample:
    """Measured depth of some frames. values: (K,) as stored, ascending.  units_per_meter: with which it is read."""

    values: NDArray[np.generic]
    units_per_meter: float

    def quantile_m(self, share: float, units_per_meter: float) -> float:
        """The depth in meters below which a share of the depth lies, if it is read with these units."""
        return float(self.values[int(share * (len(self.values) - 1))]) / units_per_meter

    def fits(self, units_per_meter: float) -> bool:
        """Whether these units make a room of the scan."""
        low, high = MEDIAN_M
        median, far = (self.quantile_m(share, units_per_meter) for share in (0.5, 0.9))
        return low <= median <= high and far <= FAR_M

    def fitting(self) -> list[float]:
        """The units that make a room of the scan, the most likely first."""
        found = [units for units in UNITS if self.fits(units)]
        likely = min(found, key=self._distance, default=0.0)
        if self.values.dtype.kind == "u":
            scaled = [units for units in (10000.0, 5000.0) if units in found and self._divisible(int(units) // 1000)]
            if scaled and self.quantile_m(0.5, 1000.0) > _FAR_MEDIAN_M:  # millimeters times 10 or 5
                likely = scaled[0]
            elif 1000.0 in found:
                likely = 1000.0
        return sorted(found, key=lambda units: units != likely)

    def nearest(self) -> float:
        """The units that bring the median depth nearest to that of a usual room."""
        return min(UNITS, key=self._distance)

    def _divisible(self, factor: int) -> bool:
        return self.values.dtype.kind == "u" and float((self.values % factor == 0).mean()) > _MULTIPLES

    def _distance(self, units_per_meter: float) -> float:
        return abs(math.log(self.quantile_m(0.5, units_per_meter) / _TYPICAL_M))


def sample_depth(capture: Capture, samples: int = _SAMPLES) -> DepthSample | None:
    """Measured depth of frames across the capture, as stored; None if they hold none."""
    values, units_per_meter = [], 1.0
    for index in spread_evenly(len(capture), samples):
        try:
            stored = capture.raw_depth(index)
        except FrameError:
            continue
        if stored is not None:
            raw, units_per_meter = stored
            values.append(_measured(raw))
    measured = np.sort(np.concatenate(values)) if values else np.zeros(0)
    return DepthSample(measured, units_per_meter) if len(measured) else None


def _measured(raw: RawDepth) -> NDArray[np.generic]:
    if raw.dtype.kind == "f":
        return np.asarray(raw[np.isfinite(raw) & (raw > 0)])
    return np.asarray(raw[(raw > 0) & (raw < SATURATED)])


def settle_depth_unit(capture: Capture) -> Notice | None:
    """Estimate the unit of the depth from the scene if nothing states it, and set it. Returns a warning if the unit is
    estimated and unusual, or if the depth that results does not look like a room; else None."""
    if not capture.has_depth:
        return None
    if (sample := sample_depth(capture)) is None:
        return _empty(capture) if _is_stored(capture) else None
    if isinstance(capture, RgbdFrames) and not capture.units_stated:
        found = sample.fitting()
        if found and found[0] != sample.units_per_meter:
            capture.units_per_meter = found[0]
            return _estimated(capture, sample, found)
    return _doubtful(capture, sample)


def _is_stored(capture: Capture) -> bool:
    try:
        return capture.raw_depth(0) is not None
    except FrameError:
        return False


def _empty(capture: Capture) -> Notice:
    return Notice(
        "depth-empty",
        f"The depth images of {capture.path} that were looked at hold no measurement: all values are 0 or 65535. "
        "Record depth, or map color alone with capture.depth=false.",
    )


def _estimated(capture: Capture, sample: DepthSample, found: list[float]) -> Notice:
    used, *others = found
    text = (
        f"Nothing states the unit of the depth of {capture.path}. It is read with {_named(used)} units per meter, by "
        f"which half of it is nearer than {sample.quantile_m(0.5, used):.2g} m"
    )
    if others:
        text += f"; {_listed(sample, others)} would suit a room, too"
    return Notice("depth-scale-doubtful", f"{text}. Set capture.depth_scale to the right one.")


def _doubtful(capture: Capture, sample: DepthSample) -> Notice | None:
    """A warning if the depth, as it is read, does not look like a room."""
    units = sample.units_per_meter
    low, high = DOUBTFUL_MEDIAN_M
    median = sample.quantile_m(0.5, units)
    within = float(np.searchsorted(sample.values, capture.options.max_depth * units, "right") / len(sample.values))
    if low <= median <= high and within >= LEAST_WITHIN:
        return None
    others = [other for other in sample.fitting() or [sample.nearest()] if other != units]
    advice = f"{_listed(sample, others)} would suit a room: set capture.depth_scale to the right one"
    if not others:
        advice = "check capture.depth_scale and capture.max_depth"
    return Notice(
        "depth-scale-doubtful",
        f"The depth of {capture.path} does not look like a room with {units:g} units per meter: its median is "
        f"{median:.3g} m, and {within:.0%} of it lies within capture.max_depth = {capture.options.max_depth:g} m; "
        f"{advice}.",
    )


def _named(units: float) -> str:
    return f"{units:g} ({UNITS[units]})" if units in UNITS else f"{units:g}"


def _listed(sample: DepthSample, units: list[float]) -> str:
    """Units with their names and the median depth, such as "4000 (RealSense L515: 2.1 m) or 5000 (TUM: 1.7 m)"."""
    parts = [f"{one:g} ({UNITS[one]}: {sample.quantile_m(0.5, one):.2g} m)" for one in units]
    return " or ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)
