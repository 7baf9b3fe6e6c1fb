"""``freeocc3d inspect``: what a capture is, what a run would do with it, and what to fix."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from .console import Json, Set, show, show_document

if TYPE_CHECKING:
    from ..pipeline.inspection import Inspection


def inspect(
    capture: Annotated[str, typer.Argument(metavar="CAPTURE", help="Folder of a scan, a recording or a video file.")],
    overrides: Set = None,
    as_json: Json = False,
) -> None:
    """Show what a capture is, what 'reconstruct' would do with it, and what to fix first."""
    from ..pipeline import inspection
    from ..settings import config

    found = inspection.inspect(capture, config.load(None, overrides or []))
    if as_json:
        show_document(found.to_dict())
    else:
        show(*_lines(found))


def _lines(found: Inspection) -> list[str]:
    """The rows of the answer: a name and what is known."""
    rows = [
        ("capture", f"{found.path}  ({found.format})"),
        ("frames", _frames(found)),
        ("color", _sizes(found)),
        ("camera", found.camera),
        ("depth", _depth(found)),
        ("poses", _poses(found)),
        ("plan", found.tracking),
    ]
    rows += [("problem", text) for text in found.problems]
    rows += [("to fix", notice.text) for notice in found.notices]
    if not found.problems and not found.notices:
        rows.append(("to fix", "nothing that shows"))
    return [f"{name:<10} {text}" for name, text in rows]


def _frames(found: Inspection) -> str:
    if found.seconds is None:
        return f"{found.frames:,}, without times"
    return f"{found.frames:,} in {found.seconds:.1f} s ({found.rate:.3g} a second)"


def _sizes(found: Inspection) -> str:
    stored = f"{found.size[0]} x {found.size[1]}"
    used = f"{found.frame_size[0]} x {found.frame_size[1]}"
    return stored if stored == used else f"{stored}, used as {used}"


def _depth(found: Inspection) -> str:
    from ..pipeline.inspection import unit_name

    if found.depth is None:
        return "none"
    depth = found.depth
    return (
        f"{depth.size[0]} x {depth.size[1]}, {unit_name(depth.unit)}: half of it is nearer than "
        f"{depth.median_m:.2g} m, 95 % nearer than {depth.far_m:.2g} m; {depth.coverage:.0%} of the pixels have depth "
        f"that is used, with the noise of {depth.sensor.replace('_', ' ')}"
    )


def _poses(found: Inspection) -> str:
    if not found.poses:
        return "none"
    stated = "stated for all frames" if found.poses == 1 else f"stated for {found.poses:.0%} of the frames"
    return stated if "Tracking with known" in found.tracking else f"{stated}; a run does not read them by default"
