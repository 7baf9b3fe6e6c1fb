"""``freeocc3d demo``: maps the built-in room, asks some words, and draws pictures."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from .console import ConsoleProgress, Overwrite, show
from .map_summary import summary_lines
from .query_answers import answers_lines

WORDS = "red cup", "blue chair", "something to sit on", "bathtub"
"""The words that the demo asks: the last one names nothing in the room."""

STAND_IN = """\
No network has seen this room. Class images, drawn with it, stand in for one, as if its encoder knew 22 words and never
erred. Colors are those of the voxels."""

REAL = """\
A real encoder finds whatever is named in any scan, less surely than here, and needs no class images:
  freeocc3d models pull words
  freeocc3d relabel {} -o {} --words words"""


def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder for the map and the pictures.")
    ] = Path("demo"),
    frames: Annotated[
        int,
        typer.Option(
            "--frames",
            metavar="N",
            min=2,
            help="Number of frames of the walk through the room. Fewer frames are faster and lie farther apart.",
        ),
    ] = 240,
    overwrite: Overwrite = False,
) -> None:
    """Map the built-in room, ask some words, and draw pictures."""
    from ..pipeline import run
    from ..settings import config
    from ..viewer import map_colorings, map_pictures

    settings = config.load(None, [f"capture.synthetic.frames={frames}", "language.encoder=labels"])
    with ConsoleProgress() as progress:
        made = run.reconstruct("builtin:room", output / "map", settings, overwrite=overwrite, progress=progress)
    show(*summary_lines(made))
    written = [output / "map.png"]
    map_pictures.write_both_picture(made, map_colorings.color_map(made), written[0], overwrite)
    results = made.query_words(list(WORDS), top_k=4)
    show("", *STAND_IN.splitlines(), "", *answers_lines(results))
    for result in results:
        if result.matched:
            written.append(output / f"query_{result.word.replace(' ', '_')}.png")
            map_pictures.write_query_picture(made, [result], written[-1], overwrite)
    real = REAL.format(*(shlex.quote(str(output / name)) for name in ("map", "map-with-words")))
    show("", *real.splitlines(), f"pictures: {', '.join(str(path) for path in written)}")
    show(f"Walk through it and ask it in a browser: freeocc3d view {shlex.quote(str(output / 'map'))}")
