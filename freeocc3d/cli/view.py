"""``freeocc3d view``: a picture of a map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .console import MapPath, Overwrite, show


def view(
    map_path: MapPath,
    picture: Annotated[Path, typer.Option("--picture", metavar="OUT.png", help="PNG file to write.")],
    word: Annotated[str | None, typer.Option("--query", metavar="WORD", help="Highlight what matches a word.")] = None,
    by: Annotated[str, typer.Option("--by", metavar="COLORS", help="Color by rgb, class or height.")] = "rgb",
    overwrite: Overwrite = False,
) -> None:
    """Draw a map from above and from a corner."""
    from ..query.scan_map import load_map
    from ..viewer import map_pictures

    loaded = load_map(map_path)
    if word is None:
        map_pictures.write_map_picture(loaded, picture, by, overwrite)
    else:
        map_pictures.write_query_picture(loaded, loaded.query_words([word]), picture, overwrite)
    show(str(picture))
