"""``freeocc3d refine``: makes a map with finer voxels."""

from __future__ import annotations

from typing import Annotated

import typer

from .console import ConsoleProgress, MapPath, NewMap, Overwrite, show
from .map_summary import summary_lines


def refine(
    map_path: MapPath,
    voxel: Annotated[float, typer.Option("--voxel", metavar="METERS", help="Edge of the finest voxels.")],
    output: NewMap,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--box",
            metavar="X0 Y0 Z0 X1 Y1 Z1",
            help="Refine all voxels of this box, and leave out the rest: lower and upper corner, map frame, meters.",
            show_default="the whole map, with finer voxels only where they show more",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Make a map with finer voxels from a map: in a box, or wherever they show more."""
    import numpy as np

    from ..editing import adaptive_voxels, box_refinement
    from ..query.scan_map import load_map

    scan_map = load_map(map_path)
    with ConsoleProgress() as progress:
        if box is None:
            made = adaptive_voxels.refine_where_needed(scan_map, voxel, output, overwrite=overwrite, progress=progress)
        else:
            corners = box_refinement.Box(np.array(box[:3]), np.array(box[3:]))
            made = box_refinement.refine_box(scan_map, corners, voxel, output, overwrite=overwrite, progress=progress)
    show(*summary_lines(made))
