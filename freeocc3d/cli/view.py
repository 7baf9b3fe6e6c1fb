"""``freeocc3d view``: maps in a browser, as one file, as pictures and videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core.atomic_files import refuse_existing
from .console import ConsoleProgress, Overwrite, flag, say, show
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


@dataclass(frozen=True)
class Browsing:
    """In a browser."""

    html: Annotated[
        Path | None,
        typer.Option("--html", metavar="OUT.html", help="Write the viewer and the map as one file to open anywhere."),
    ] = None
    live: Annotated[bool, flag("--live", "Follow a map that is being made; it need not exist yet.")] = False
    host: Annotated[
        str, typer.Option("--host", metavar="HOST", help="Where to listen: this machine only, unless given.")
    ] = "127.0.0.1"
    port: Annotated[
        int | None,
        typer.Option("--port", min=0, max=65535, metavar="N", help="Port: 8080 or the next free one; 0 = any."),
    ] = None
    no_browser: Annotated[bool, flag("--no-browser", "Only print the address.")] = False


@grouped
def view(
    map_paths: Annotated[list[Path], typer.Argument(metavar="MAP", help="Map folders, shown side by side.")],
    browsing: Browsing,
    drawing: Drawing,
) -> None:
    """Look at maps in a browser; or write one file, a picture or a video.

    Without --html, --picture or --video, opens the viewer and serves it until Ctrl-C.
    """
    files = [*drawing.files, *([browsing.html] if browsing.html else [])]
    _refuse_conflicts(drawing, browsing, files, map_paths)
    if not files:
        _serve(map_paths, browsing)
        return
    for path in files:
        refuse_existing(path, drawing.overwrite)
    if drawing.video is not None:
        from ..viewer.turntables import check_video_name

        check_video_name(drawing.video)
    from ..query.scan_map import load_map

    loaded = load_map(map_paths[0])
    if browsing.html is not None:
        from ..viewer.browser.single_file import write_whole_page

        write_whole_page(loaded, browsing.html, drawing.words or (), drawing.overwrite)
    if drawing.files:
        _draw(loaded, drawing)
    for path in files:
        show(str(path))


def _serve(map_paths: list[Path], browsing: Browsing) -> None:
    from ..viewer.browser.serving import serve_maps

    def tell(address: str) -> None:
        show(address)
        say("Ctrl-C ends the viewer.")

    serve_maps(map_paths, browsing.host, browsing.port, not browsing.no_browser, tell, browsing.live)


def _refuse_conflicts(drawing: Drawing, browsing: Browsing, files: list[Path], map_paths: list[Path]) -> None:
    """Raises BadParameter, which names what to leave out or to add."""
    if files and len(map_paths) > 1:
        raise typer.BadParameter("a file shows one map: give one MAP, or leave the files out to see maps side by side.")
    if files and browsing.live:
        raise typer.BadParameter("--live opens the viewer: leave out --html, --picture and --video.")
    if browsing.html is not None and browsing.html.suffix.lower() not in (".html", ".htm"):
        raise typer.BadParameter(f"--html writes a page: use the name {browsing.html.with_suffix('.html')}.")
    if not files and drawing.words:
        raise typer.BadParameter("--query needs --picture, --video or --html; in the viewer, type the word.")
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
