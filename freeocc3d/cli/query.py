"""``freeocc3d query``: asks a map, and prints, draws or writes the answer. Heavy imports happen inside."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .. import __version__
from ..core.atomic_files import refuse_existing
from ..core.errors import FreeOccError
from .console import ConsoleProgress, Json, MapPath, Overwrite, ask_for_line, flag, say, show, show_document
from .option_groups import grouped

if TYPE_CHECKING:
    from ..query.questions import Question
    from ..query.regions import Region
    from ..query.scan_map import Map
    from ..query.word_query import QueryResult
    from .query_answers import AnswerFrame


@dataclass(frozen=True)
class Asked:
    """What to look for."""

    words: Annotated[
        list[str] | None, typer.Argument(metavar="WORD", help="Words or quoted phrases.", show_default=False)
    ] = None
    negative: Annotated[
        list[str] | None, typer.Option("--not", metavar="WORD", help="What the words do not mean; repeatable.")
    ] = None
    class_names: Annotated[
        list[str] | None,
        typer.Option("--class", metavar="NAME", help="All voxels of a class of the map's vocabulary; repeatable."),
    ] = None
    image: Annotated[
        Path | None, typer.Option("--image", metavar="FILE", help="Find what a picture shows, if the encoder can.")
    ] = None
    image_box: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option("--box", metavar="X0 Y0 X1 Y1", help="With --image: only these pixels, both corners included."),
    ] = None
    interactive: Annotated[
        bool,
        flag("--interactive", "Keep the map loaded and answer each line of the input. Commas separate phrases."),
    ] = False
    list_classes: Annotated[bool, flag("--classes", "Only list the classes of the map's vocabulary.")] = False

    @property
    def questions(self) -> int:
        """The number of answers."""
        return len(self.words or ()) + len(self.class_names or ()) + (self.image is not None)


@dataclass(frozen=True)
class Place:
    """Where the regions must be."""

    near: Annotated[
        str | None,
        typer.Option("--near", metavar="WORD[:METERS]", help="At most METERS away from WORD, 0.5 if not given."),
    ] = None
    on: Annotated[str | None, typer.Option("--on", metavar="WORD", help="On top of WORD.")] = None
    within: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option("--within", metavar="X0 Y0 Z0 X1 Y1 Z1", help="With the centroid in a box, map frame, meters."),
    ] = None
    pick: Annotated[
        str | None, typer.Option("--pick", metavar="WHICH", help="Only the largest, highest, lowest or best region.")
    ] = None


@dataclass(frozen=True)
class Ranking:
    """What matches."""

    top: Annotated[int | None, typer.Option("--top", min=1, metavar="K", help="At most K regions for each word.")] = (
        None
    )
    objects: Annotated[
        bool | None,
        flag(
            "--objects/--voxels",
            "Whole objects first and then what else matches, or regions of voxels alone. By default objects, if the "
            "map keeps them, as maps with words do.",
        ),
    ] = None
    threshold: Annotated[
        float | None, typer.Option("--threshold", min=-1, max=1, metavar="T", help="Lowest score of a match, -1 to 1.")
    ] = None
    scores: Annotated[
        str | None,
        typer.Option("--scores", metavar="KIND", help="How scores are computed: cosine, softmax or relevancy."),
    ] = None


@dataclass(frozen=True)
class Answer:
    """What comes out."""

    as_json: Json = False
    frame: Annotated[
        str,
        typer.Option("--frame", metavar="FRAME", help="Frame of printed places: map, start, first-camera or gravity."),
    ] = "map"
    views: Annotated[
        bool,
        flag("--views", "With --json: add keyframes that show a region, and where to stand to see it."),
    ] = False
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="OUT.png", help="Draw the map with colored matches.")
    ] = None
    html: Annotated[
        Path | None,
        typer.Option("--html", metavar="OUT.html", help="Write a page with the regions, the map, and camera images."),
    ] = None
    ply: Annotated[
        Path | None, typer.Option("--ply", metavar="OUT.ply", help="Write the map as a mesh with colored matches.")
    ] = None
    overwrite: Overwrite = False

    @property
    def files(self) -> list[Path]:
        """The files that are written."""
        return [path for path in (self.ply, self.picture, self.html) if path is not None]


@dataclass(frozen=True)
class Closer:
    """A closer look."""

    refine_to: Annotated[
        float | None,
        typer.Option("--refine", metavar="METERS", help="Ask again with finer voxels around the best match."),
    ] = None
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="MAP", help="Keep the map that --refine makes.")
    ] = None


@grouped
def query(map_path: MapPath, asked: Asked, place: Place, ranking: Ranking, answer: Answer, closer: Closer) -> None:
    """Ask a map where something is.

    Regions are ranked by score, 0 to 1: how well they fit the word.
    The confidence, 0 to 1, compares the word with the others that the map knows.
    Low score, high confidence: the word fits badly, but no other fits better.
    For a picture (--image), the confidence is the mean similarity.
    """
    from ..query.questions import ask
    from ..query.scan_map import load_map

    if asked.list_classes:
        show(*load_map(map_path).vocabulary)
        return
    _refuse_conflicts(asked, answer, closer)
    for target in answer.files:
        refuse_existing(target, answer.overwrite)
    if answer.ply is not None:
        from ..export.file_names import check_ending

        check_ending(answer.ply, (".ply",), "ply")
    question = _question(asked, place, ranking)
    loaded = load_map(map_path)
    if asked.interactive:
        _answer_lines(loaded, question, answer)
        return
    results = ask(loaded, question)
    with tempfile.TemporaryDirectory() as folder:  # for a refined map without -o
        if closer.refine_to is not None and results[0].matched:
            output = closer.output or Path(folder) / "refined"
            loaded = _refined(loaded, results[0].regions[0], closer.refine_to, output, answer.overwrite)
            results = ask(loaded, question)
        _write_files(loaded, results, answer)
        _show(map_path, loaded, results, answer)


def _refuse_conflicts(asked: Asked, answer: Answer, closer: Closer) -> None:
    """Raises BadParameter, which names what to leave out or to add."""
    if asked.interactive == bool(asked.questions):
        raise typer.BadParameter("give words to look for, --class or --image, or --interactive without any.")
    if asked.interactive and (answer.files or closer.refine_to is not None):
        raise typer.BadParameter(
            "--interactive answers in text or JSON: leave out --ply, --picture, --html and --refine."
        )
    if asked.image_box is not None and asked.image is None:
        raise typer.BadParameter("--box selects a part of a picture: give --image, too.")
    if asked.negative and asked.questions > len(asked.words or ()):
        raise typer.BadParameter("--not narrows what words mean: leave it out with --class and --image.")
    if closer.output is not None and closer.refine_to is None:
        raise typer.BadParameter("-o keeps the map that --refine makes: give --refine METERS.")
    if answer.views and not answer.as_json:
        raise typer.BadParameter("--views adds to the document of --json: give --json, too.")
    if closer.refine_to is not None and asked.questions > 1:
        raise typer.BadParameter("--refine looks around the best match of one word.")
    if len(set(answer.files)) < len(answer.files):
        raise typer.BadParameter("give --ply, --picture and --html different file names.")


def _question(asked: Asked, place: Place, ranking: Ranking) -> Question:
    from ..query.conditions import Where, near_word
    from ..query.questions import Question

    where = None
    if any(condition is not None for condition in vars(place).values()):
        word, meters = (None, Where.near_m) if place.near is None else near_word(place.near)
        where = Where(place.within, word, meters, place.on, place.pick)
    options = {"top_k": ranking.top, "threshold": ranking.threshold, "scores": ranking.scores}
    return Question(
        words=tuple(asked.words or ()),
        classes=tuple(asked.class_names or ()),
        image=asked.image,
        image_box=asked.image_box,
        negative=tuple(asked.negative or ()),
        where=where,
        objects=ranking.objects,
        options={name: value for name, value in options.items() if value is not None},
    )


def _write_files(loaded: Map, results: list[QueryResult], answer: Answer) -> None:
    if answer.ply is not None:
        from ..export.ply import write_query_ply

        write_query_ply(loaded.occupancy, results, answer.ply, answer.overwrite)
    if answer.picture is not None:
        from ..viewer.map_pictures import write_query_picture

        write_query_picture(loaded, results, answer.picture, answer.overwrite)
    if answer.html is not None:
        from ..viewer.answer_page import write_query_page

        write_query_page(loaded, results, answer.html, answer.overwrite)


def _show(map_path: Path, loaded: Map, results: Sequence[QueryResult], answer: Answer) -> None:
    from .query_answers import answers_document, answers_lines

    frame = _frame(loaded, answer.frame)
    if answer.as_json:
        from .region_details import describe_regions

        more = describe_regions(loaded, results, answer.views, frame.T_frame_map)
        show_document(answers_document(map_path, results, more, loaded.metric, frame))
        return
    unit = "The map's scale is unknown, so lengths are not meters (see freeocc3d scale)."
    show(*answers_lines(results, loaded.metric, frame), *([] if loaded.metric else [unit]))


def _frame(loaded: Map, name: str) -> AnswerFrame:
    """The frame of that name. Raises FreeOccError."""
    import numpy as np

    from ..query.moved_regions import region_mover
    from .query_answers import AnswerFrame

    if name == "map":
        return AnswerFrame(name, np.eye(4), lambda region: region)
    from ..export.export_frames import to_frame

    T_frame_map = to_frame(loaded, name)
    return AnswerFrame(name, T_frame_map, region_mover(loaded.occupancy, T_frame_map))


def _answer_lines(loaded: Map, question: Question, answer: Answer) -> None:
    """Answer each line of the standard input until it ends. A line without an answer gives one sentence on stderr, or
    with --json a document with "error" in place of "results": each line that is not empty has its document."""
    from dataclasses import replace

    from ..query.questions import ask

    while True:
        if sys.stdin.isatty():
            ask_for_line()
        line = sys.stdin.readline()
        if not line:
            return
        words = tuple(word.strip() for word in line.split(",") if word.strip())
        if not words:
            continue
        try:
            results = ask(loaded, replace(question, words=words))
            _show(loaded.path, loaded, results, answer)
        except FreeOccError as error:
            said = " ".join(str(error).split())
            if answer.as_json:
                show_document({"version": __version__, "map": str(loaded.path), "error": said})
            else:
                say(f"freeocc3d: {said}")


def _refined(loaded: Map, region: Region, voxel_size: float, output: Path, overwrite: bool) -> Any:
    from ..editing import box_refinement

    box = box_refinement.enclose_region(region, loaded.manifest.voxel_size_m)
    with ConsoleProgress() as progress:
        return box_refinement.refine_box(loaded, box, voxel_size, output, overwrite=overwrite, progress=progress)
