"""``freeocc3d scale``: gives meters to a map whose scale is unknown."""

from __future__ import annotations

from typing import Annotated

import typer

from .console import MapPath, NewMap, Overwrite, show
from .map_summary import summary_lines


def scale(
    map_path: MapPath,
    output: NewMap,
    factor: Annotated[float | None, typer.Option("--factor", metavar="S", help="Meters per unit of the map.")] = None,
    length: Annotated[
        tuple[str, str, float] | None,
        typer.Option(
            "--length",
            metavar="POINT POINT METERS",
            help="The distance between two points. A point is a pixel of a keyframe, FRAME:X,Y, or a word.",
        ),
    ] = None,
    camera_height: Annotated[
        float | None,
        typer.Option("--camera-height", metavar="METERS", help="The height of the cameras above the floor."),
    ] = None,
    poses: Annotated[
        str | None, typer.Option("--poses", metavar="FILE|CAPTURE", help="Poses of the same frames in meters.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Make a map in meters from a map whose scale is unknown.

    Give one of --factor, --length, --camera-height and --poses.
    """
    from ..editing import scaling
    from ..query.scan_map import load_map

    if [factor, length, camera_height, poses].count(None) != 3:
        raise typer.BadParameter("give one of --factor, --length, --camera-height and --poses.")
    loaded = load_map(map_path)
    by = "given"
    if length is not None:
        factor, by = scaling.scale_by_length(loaded, length[:2], length[2]), "length"
    elif camera_height is not None:
        factor, by = scaling.scale_by_camera_height(loaded, camera_height), "camera height"
    elif poses is not None:
        factor, by = scaling.scale_by_poses(loaded, poses), "poses"
    assert factor is not None
    show(*summary_lines(scaling.scale_map(loaded, factor, by, output, overwrite=overwrite)))
