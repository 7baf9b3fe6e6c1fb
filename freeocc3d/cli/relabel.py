"""``freeocc3d relabel``: gives a map the words of another model."""

from __future__ import annotations

from typing import Annotated

import typer

from .console import ConsoleProgress, MapPath, NewMap, Overwrite, show
from .map_summary import summary_lines
from .words import WordsHelp, obtain_words


def relabel(
    map_path: MapPath,
    output: NewMap,
    words: Annotated[str, typer.Option("--words", metavar="NAME", help=WordsHelp)] = "words",
    overwrite: Overwrite = False,
) -> None:
    """Make a map that understands words from a map, without its capture: its keyframes are encoded anew."""
    from ..editing import relabeling
    from ..query.scan_map import load_map

    scan_map = load_map(map_path)
    with ConsoleProgress() as progress:
        package = obtain_words(words, progress)
        made = relabeling.relabel_map(scan_map, package, output, overwrite=overwrite, progress=progress)
    show(*summary_lines(made))
