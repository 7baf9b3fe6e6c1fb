"""``freeocc3d view``: pictures and videos of a map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core.atomic_files import refuse_existing
from .console import ConsoleProgress, MapPath, Overwrite, show
from .option_groups import grouped

if TYPE_CHECKING:
    from ..query.scan_map import Map
    from ..viewer.map_colorings import MapColoring


@dataclass(frozen=True)
class Drawing:
    """Pictures and videos."""

    picture: Annotated[
        Path | None,
        typer.Option("--picture", metavar="OUT.png", help="Draw voxels and Gaussians from above and from a corner."),
    ] = None
    video: Annotated[
        Path | None, typer.Option("--video", metavar="OUT.mp4", help="Write a video that goes around the map.")
    ] = None
    words: Annotated[
        list[str] | None,
        typer.Option("--query", metavar="WORD", help="Color what matches a word, with its name; repeatable."),
    ] = None
    by: Annotated[str, typer.Option("--by", metavar="COLORS", help="Color by rgb, class or height.")] = "rgb"
    place: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--from", metavar="X Y Z", help="With --to: draw what one sees from here, map frame, meters."),
    ] = None
    target: Annotated[
        tuple[float, float, float] | None, typer.Option("--to", metavar="X Y Z", help="The place to look at.")
    ] = None
    seconds: Annotated[
        float, typer.Option("--seconds", min=1, max=120, metavar="S", help="Length of the video, 1 to 120.")
    ] = 10.0
    fps: Annotated[int, typer.Option("--fps", min=1, max=60, metavar="N", help="Frames a second, 1 to 60.")] = 24
    overwrite: Overwrite = False

    @property
    def files(self) -> list[Path]:
        """The files that are written."""
        return [path for path in (self.picture, self.video) if path is not None]


@grouped
def view(map_path: MapPath, drawing: Drawing) -> None:
    """Draw a map, or what one sees in it from a place; make a video of it."""
    from ..query.scan_map import load_map

    _refuse_conflicts(drawing)
    for path in drawing.files:
        refuse_existing(path, drawing.overwrite)
    if drawing.video is not None:
        from ..viewer.turntables import check_video_name

        check_video_name(drawing.video)
    loaded = load_map(map_path)
    _draw(loaded, drawing)
    for path in drawing.files:
        show(str(path))


def _refuse_conflicts(drawing: Drawing) -> None:
    """Raises BadParameter, which names what to leave out or to add."""
    if not drawing.files:
        raise typer.BadParameter("give --picture OUT.png or --video OUT.mp4.")
    if (drawing.place is None) != (drawing.target is None):
        raise typer.BadParameter("--from and --to go together: give both.")
    if drawing.place is not None and drawing.picture is None:
        raise typer.BadParameter("--from and --to draw a picture: give --picture OUT.png, too.")
    if drawing.words and drawing.by != "rgb":
        raise typer.BadParameter("--by colors a map without words: leave it out with --query.")


def _draw(loaded: Map, drawing: Drawing) -> None:
    from ..viewer import map_pictures

    coloring = _coloring(loaded, drawing)
    if drawing.picture is not None:
        if drawing.place is None or drawing.target is None:
            map_pictures.write_both_picture(loaded, coloring, drawing.picture, drawing.overwrite)
        else:
            map_pictures.write_place_picture(
                loaded, coloring, drawing.place, drawing.target, drawing.picture, drawing.overwrite
            )
    if drawing.video is not None:
        from ..viewer.turntables import write_turntable

        with ConsoleProgress() as progress:
            write_turntable(loaded, coloring, drawing.video, drawing.seconds, drawing.fps, drawing.overwrite, progress)


def _coloring(loaded: Map, drawing: Drawing) -> MapColoring:
    from ..viewer.map_colorings import color_answers, color_map

    if drawing.words:
        return color_answers(loaded, loaded.query_words(drawing.words))
    return color_map(loaded, drawing.by)
