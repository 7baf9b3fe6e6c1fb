"""What a map says of its own quality, without any truth: ``freeocc3d check``, and a line in every report.

The keyframes are compared with each other at the map's poses (``tracking.view_agreement``), the voxels with the depth
images that were counted in them, and rendered Gaussians with frames that they were not fitted to. The limits of the
verdicts are round numbers beyond what the captures of docs/how-to/check.md showed; none depends on the unit of length.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.sampling import spread_evenly
from ..core.types import OCCUPIED, Frame, Gaussians, Occupancy
from ..gaussians import rendered_views
from ..gaussians.rasterizers.base import Rasterizer
from ..gaussians.rendered_views import CapturedView
from ..settings import registry
from ..storage.saved_map import SavedMap
from ..tracking import view_agreement
from ..tracking.view_agreement import Agreement, ComparedView, PairAgreement

VERDICTS = "good", "fair", "poor"

_HELD_OUT = 12  # most frames between keyframes that are rendered
_SAME_COLOR = 6.0  # largest mean difference of gray values between a keyframe and its frame in the capture, 0…255
_LEAST_PAIRS = 10  # revisits that tell a smooth error of the sensor
_SOLID = 0.5  # least alpha of a pixel that Gaussians cover
_DIGITS = 5


class Limits(NamedTuple):
    """What is usual. low, high: smallest and largest value on the captures that were measured.  good, poor: the verdict
    is good up to the first and poor beyond the second; downward if ``good`` is the larger one."""

    low: float
    high: float
    good: float
    poor: float


LIMITS = {
    "step": Limits(0.002, 0.004, 0.006, 0.015),
    "revisit": Limits(0.9, 1.4, 1.4, 2.25),
    "step_gray": Limits(0.5, 3.5, 5.0, 10.0),
    "revisit_gray": Limits(3.0, 8.0, 10.0, 20.0),
    "seen_through": Limits(0.0, 0.025, 0.03, 0.10),
    "unmeasured": Limits(0.03, 0.13, 0.2, 0.4),
    "closures_refused": Limits(0.0, 0.0, 0.1, 0.3),
    "distortion": Limits(0.0003, 0.005, 0.006, 0.02),
    "psnr_held_out": Limits(21.0, 28.0, 17.0, 14.0),
    "psnr_keyframes": Limits(21.0, 28.0, 17.0, 14.0),
    "rendered": Limits(0.98, 1.0, 0.95, 0.8),
    "posed": Limits(1.0, 1.0, 0.95, 0.8),
}


@dataclass(frozen=True)
class Measure:
    """One measure. name: see ``LIMITS``.  value: None = it cannot be told.  unit: ``m`` (the map's unit of length if
    its scale is unknown), ``share``, ``gray`` (0…255) or ``dB``.  compared: the value as ``usual`` is stated, which for
    lengths is a share of the median depth (``step``, ``distortion``), or in standard deviations of the noise a multiple
    of the step's (``revisit``).  count: of what it is the median, the mean or the share."""

    name: str
    value: float | None
    unit: str
    compared: float | None
    count: int

    @property
    def usual(self) -> tuple[float, float]:
        """Smallest and largest ``compared`` that were measured on usual captures."""
        return LIMITS[self.name].low, LIMITS[self.name].high

    @property
    def verdict(self) -> str:
        """In a word; empty if there is no value."""
        if self.compared is None:
            return ""
        _, _, good, poor = LIMITS[self.name]
        sign = 1 if good < poor else -1
        return VERDICTS[int(sign * self.compared > sign * good) + int(sign * self.compared > sign * poor)]


@dataclass(frozen=True)
class MapCheck:
    """The measures of a map. views: the keyframes as they were compared.  agreement: the compared pairs of them.
    notes: why something has no value."""

    measures: tuple[Measure, ...]
    views: Sequence[ComparedView]
    agreement: Agreement
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """The worst verdict of all measures; empty if nothing could be measured."""
        return max((measure.verdict for measure in self.measures), key=("", *VERDICTS).index, default="")

    def worst(self, count: int) -> list[PairAgreement]:
        """The pairs at revisits, or else of neighbors, whose depth differs most."""
        pairs = self.agreement.revisits or self.agreement.steps
        return sorted(pairs, key=lambda pair: -pair.off_m)[:count]

    def summary(self) -> dict[str, Any]:
        """For report.json."""
        told = {
            measure.name: {
                "value": None if measure.value is None else float(f"{measure.value:.{_DIGITS}g}"),
                "unit": measure.unit, "count": measure.count, "verdict": measure.verdict,
            }
            for measure in self.measures
        }  # fmt: skip
        return {"verdict": self.verdict, "measures": told}


def check_agreement(
    views: Sequence[ComparedView],
    T_world_keyframe: NDArray[np.float64],
    occupancy: Occupancy,
    closures_held: Sequence[bool],
) -> MapCheck:
    """The measures that need no more than a run has at its end. views: of the keyframes.  closures_held: whether the
    poses agree with each loop closure."""
    agreement = view_agreement.measure_agreement(views, T_world_keyframe)
    step, step_sigmas, step_gray = _medians(agreement.steps)
    revisit, revisit_sigmas, revisit_gray = _medians(agreement.revisits)
    depth = _median_depth([views[row] for row in spread_evenly(len(views), _HELD_OUT)])
    steps, revisits = len(agreement.steps), len(agreement.revisits)
    free, hits = (counts[occupancy.state == OCCUPIED] for counts in (occupancy.free, occupancy.hits))
    refused = [not held for held in closures_held]
    return MapCheck(
        (
            Measure("step", step, "m", _ratio(step, depth), steps),
            Measure("revisit", revisit, "m", _ratio(revisit_sigmas, step_sigmas), revisits),
            Measure("step_gray", step_gray, "gray", step_gray, steps),
            Measure("revisit_gray", revisit_gray, "gray", revisit_gray, revisits),
            _share("seen_through", free > hits),
            _share("unmeasured", hits == 0),
            _share("closures_refused", refused),
        ),
        views,
        agreement,
    )


def check_map(scan_map: SavedMap) -> MapCheck:
    """All measures of a saved map: from its folder, and from frames between its keyframes if its capture is still
    there. Raises MapError for a damaged map."""
    report, trajectory = scan_map.report, scan_map.trajectory
    views = view_agreement.prepare_compared_views(scan_map.keyframes)
    held = [closure[2] for submap in report.get("submaps", []) for closure in submap["closures"]]
    checked = check_agreement(views, trajectory.T_world_keyframe, scan_map.occupancy, held)
    rendering = report.get("rendering") or {}
    held_out, frames, note = _render_held_out(scan_map)
    posed = trajectory.has_pose[trajectory.status != "unused"]
    more = (
        _measure_distortion(checked, trajectory.T_world_keyframe),
        Measure("psnr_held_out", held_out, "dB", held_out, frames),
        Measure("psnr_keyframes", rendering.get("psnr_measured"), "dB", rendering.get("psnr_measured"), len(views)),
        Measure("rendered", rendering.get("covered"), "share", rendering.get("covered"), len(views)),
        _share("posed", posed),
    )
    notes = tuple(text for text in (_why_no_revisits(checked.agreement), note) if text)
    return dataclasses.replace(checked, measures=checked.measures + more, notes=notes)


def _measure_distortion(checked: MapCheck, T_world_keyframe: NDArray[np.float64]) -> Measure:
    """How much the sensor's depth errs from one part of its image to another, at the median depth."""
    views, pairs = checked.views, checked.agreement.revisits
    depth = _median_depth(views)
    if depth is None or len(pairs) < _LEAST_PAIRS:
        return Measure("distortion", None, "m", None, len(pairs))
    found = view_agreement.measure_distortion(views, T_world_keyframe, pairs)
    half_range = view_agreement.distortion_range(found, views[0].camera, depth)
    return Measure("distortion", half_range, "m", half_range / depth, len(pairs))


def _medians(pairs: Sequence[PairAgreement]) -> tuple[float | None, ...]:
    """Medians over pairs of the differences of depth, in meters and in standard deviations, and of gray values."""
    if not pairs:
        return None, None, None
    return tuple(float(np.median([getattr(pair, name) for pair in pairs])) for name in ("off_m", "sigmas", "gray"))


def _median_depth(views: Sequence[ComparedView]) -> float | None:
    measured = [np.median(view.depth_m[view.depth_m > 0]) for view in views if (view.depth_m > 0).any()]
    return float(np.median(measured)) if measured else None


def _ratio(value: float | None, of: float | None) -> float | None:
    return value / of if value is not None and of else None


def _share(name: str, among: Sequence[bool] | NDArray[np.bool_]) -> Measure:
    value = float(np.mean(among)) if len(among) else None
    return Measure(name, value, "share", value, len(among))


def _why_no_revisits(agreement: Agreement) -> str:
    if agreement.revisits:
        return ""
    return "No two keyframes show the same place after the camera looked elsewhere: nothing tells whether poses drift."


def _render_held_out(scan_map: SavedMap) -> tuple[float | None, int, str]:
    """PSNR in dB where depth is measured, over frames between keyframes, how many, and why there is no value. Of frames
    without depth, the pixels that Gaussians cover are compared."""
    trajectory, keyframes = scan_map.trajectory, scan_map.keyframes
    between = np.flatnonzero(np.isin(trajectory.status, ("tracked", "relocalised")))
    if not len(between):
        return None, 0, "All frames that were tracked are keyframes, so no frame is held out from fitting."
    chosen = between[spread_evenly(len(between), _HELD_OUT)].tolist()
    try:
        capture = scan_map.capture
        if not len(keyframes) or not _same_image(capture[int(trajectory.keyframes[0])], keyframes[0]):
            return None, 0, "Frames of the capture are not as the run used them, so held-out frames are not rendered."
        frames = [(capture[index], trajectory.T_world_cam[index]) for index in chosen]
    except FreeOccError as error:
        return None, 0, f"No held-out frames are rendered: {error}"
    rasterizer, width = registry.load("gaussians.rasterizers", "cpu").load(), scan_map.settings.fitting.width
    rendered = [rendered_views.prepare_captured_view(frame, T, width, rasterizer.device) for frame, T in frames]
    if not capture.has_depth:
        rendered = [_with_rendered_depth(scan_map.gaussians, view, rasterizer) for view in rendered]
    return rendered_views.measure_fidelity(scan_map.gaussians, rendered, rasterizer).psnr_measured, len(frames), ""


def _with_rendered_depth(gaussians: Gaussians, view: CapturedView, rasterizer: Rasterizer) -> CapturedView:
    """The view with a depth where Gaussians cover it, so that these pixels are compared."""
    rendered = rendered_views.render_gaussians(gaussians, view, rasterizer)
    return dataclasses.replace(view, depth_m=rendered.depth * (rendered.alpha >= _SOLID))


def _same_image(read: Frame, kept: Frame) -> bool:
    """Whether a frame of the capture is the saved keyframe, in which a lens may have been undone."""
    if read.intrinsics != kept.intrinsics or read.color.shape != kept.color.shape:
        return False
    return float(np.abs(read.color.astype(np.float32) - kept.color).mean()) < _SAME_COLOR
