"""``freeocc3d upright``: lets a map of an earlier version stand upright."""

from __future__ import annotations

from .console import ConsoleProgress, MapPath, NewMap, Overwrite, show
from .map_summary import summary_lines


def upright(map_path: MapPath, output: NewMap, overwrite: Overwrite = False) -> None:
    """Make a map that stands upright from a map of an earlier version: z up, the floor at z = 0."""
    from ..editing.standing_upright import stand_upright
    from ..query.scan_map import load_map

    with ConsoleProgress() as progress:
        made = stand_upright(load_map(map_path), output, overwrite=overwrite, progress=progress)
    show(*summary_lines(made))
