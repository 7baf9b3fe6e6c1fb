"""``freeocc3d check``: how good a map is, as far as it can tell without the truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core.atomic_files import refuse_existing
from .console import Json, MapPath, Overwrite, show, show_document
from .map_summary import MEASURE_NAMES, length_text

if TYPE_CHECKING:
    from ..pipeline.map_check import MapCheck, Measure
    from ..query.scan_map import Map

_WORST = 5
_RELATIVE = {
    "step": "of the depth",
    "revisit": "x the step's for its distances",
    "distortion": "of the depth",
}


def check(
    map_path: MapPath,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="OUT.png", help="Draw where depth disagrees, a PNG file.")
    ] = None,
    as_json: Json = False,
    overwrite: Overwrite = False,
) -> None:
    """Say how well a map agrees with itself, without the truth."""
    from ..pipeline.map_check import check_map
    from ..query.scan_map import load_map

    if picture is not None:
        refuse_existing(picture, overwrite)
    loaded = load_map(map_path)
    found = check_map(loaded)
    if picture is not None:
        from ..viewer.check_picture import write_check_picture

        write_check_picture(loaded, found.views, found.agreement, picture, overwrite)
    if as_json:
        show_document(check_document(loaded, found))
    else:
        show(*told_lines(loaded, found))


def check_document(loaded: Map, found: MapCheck) -> dict[str, Any]:
    """What ``check --json`` prints."""
    frames = loaded.manifest.keyframes
    return {
        "version": loaded.manifest.freeocc3d,
        "map": str(loaded.path),
        "metric": loaded.metric,
        "verdict": found.verdict,
        "measures": {
            measure.name: {
                "value": measure.value,
                "unit": measure.unit,
                "count": measure.count,
                "compared": measure.compared,
                "usual": list(measure.usual),
                "verdict": measure.verdict,
            }
            for measure in found.measures
        },
        "worst": [
            {
                "frames": [frames[pair.source], frames[pair.target]],
                "off_m": pair.off_m,
                "gray": pair.gray,
                "seen_through": pair.seen_through,
            }
            for pair in found.worst(_WORST)
        ],
        "notes": list(found.notes),
    }


def told_lines(loaded: Map, found: MapCheck) -> list[str]:
    """What ``check`` prints for people."""
    rows = [("", "measured", "usual", "")]
    rows += [
        (MEASURE_NAMES[measure.name], _value(measure, loaded.metric), _usual(measure), measure.verdict or "not told")
        for measure in found.measures
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = [f"{name:<{widths[0]}}  {value:>{widths[1]}}  {usual:>{widths[2]}}  {verdict}".rstrip()
             for name, value, usual, verdict in rows]  # fmt: skip
    worst = found.worst(_WORST)
    if worst:
        frames = loaded.manifest.keyframes
        ends = [(frames[pair.target], frames[pair.source], length_text(pair.off_m, loaded.metric)) for pair in worst]
        lines.append(f"worst      frames {', '.join(f'{first} and {last} ({off})' for first, last, off in ends)}")
    lines += [f"note       {note}" for note in found.notes]
    return [*lines, f"verdict    {found.verdict or 'nothing could be measured'}"]


def _value(measure: Measure, metric: bool) -> str:
    if measure.value is None:
        return "-"
    if measure.unit == "m":
        relative = "" if measure.compared is None else f", {_compared(measure.name, measure.compared)}"
        return f"{length_text(measure.value, metric)}{relative} {_RELATIVE[measure.name]}"
    return _compared(measure.name, measure.value)


def _usual(measure: Measure) -> str:
    low, high = (_compared(measure.name, value) for value in measure.usual)
    return low if low == high else f"{low} to {high}"


def _compared(name: str, value: float) -> str:
    """A value as what is usual is stated."""
    if name == "revisit":
        return f"{value:.2f}"
    if name.startswith("psnr"):
        return f"{value:.1f} dB"
    if name.endswith("gray"):
        return f"{value:.1f} of 255"
    return f"{100 * value:.{2 if name in ('step', 'distortion') else 1}f} %"
