"""``freeocc3d query``: asks a map, and prints, draws or writes the answer. Heavy imports happen inside."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from .. import __version__
from ..core.atomic_files import refuse_existing
from ..core.errors import FreeOccError
from .console import ConsoleProgress, Json, MapPath, Overwrite


def query(
    map_path: MapPath,
    words: Annotated[
        list[str] | None, typer.Argument(metavar="WORD...", help="Words or quoted phrases.", show_default=False)
    ] = None,
    as_json: Json = False,
    interactive: Annotated[
        bool,
        typer.Option(
            "--interactive", help="Keep the map loaded and answer each line of the input, phrases separated by commas."
        ),
    ] = False,
    top: Annotated[int | None, typer.Option("--top", metavar="K", help="At most K regions a word.")] = None,
    threshold: Annotated[float | None, typer.Option("--threshold", help="Least score, 0…1.")] = None,
    scores: Annotated[str | None, typer.Option("--scores", help="cosine, softmax or relevancy.")] = None,
    ply: Annotated[Path | None, typer.Option("--ply", help="Write the map as PLY, matches coloured.")] = None,
    picture: Annotated[Path | None, typer.Option("--picture", help="Write a picture, matches coloured (PNG).")] = None,
    html: Annotated[
        Path | None, typer.Option("--html", help="Write one page: regions, the map, and what the camera saw of them.")
    ] = None,
    class_names: Annotated[
        list[str] | None,
        typer.Option("--class", metavar="NAME", help="All voxels of a class of the map's vocabulary; repeatable."),
    ] = None,
    list_classes: Annotated[bool, typer.Option("--classes", help="List the map's vocabulary, and do no more.")] = False,
    image: Annotated[
        Path | None, typer.Option("--image", help="Look for what a picture shows, where the map's encoder can.")
    ] = None,
    image_box: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option("--box", metavar="X0 Y0 X1 Y1", help="With --image: only these pixels of it, the last included."),
    ] = None,
    negative: Annotated[
        list[str] | None, typer.Option("--not", metavar="WORD", help="What is not meant; repeatable.")
    ] = None,
    within: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option("--within", metavar="X0 Y0 Z0 X1 Y1 Z1", help="Regions whose centroid is in a box, map frame."),
    ] = None,
    near: Annotated[
        str | None,
        typer.Option("--near", metavar="WORD[:METRES]", help="Regions with a gap to WORD of at most METRES [0.5]."),
    ] = None,
    on: Annotated[str | None, typer.Option("--on", metavar="WORD", help="Regions that stand on WORD.")] = None,
    pick: Annotated[str | None, typer.Option("--pick", help="Only the largest, highest, lowest or best.")] = None,
    views: Annotated[
        bool, typer.Option("--views", help="With --json: also the keyframes that show each region, and where to stand.")
    ] = False,
    refine_to: Annotated[
        float | None,
        typer.Option("--refine", metavar="METRES", help="Look again with finer voxels, around the best match."),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Keep the map that --refine makes.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Ask a map where something is.

    score, by which regions are ranked, 0…1: how well the voxels fit the word, as if a litre that does not fit belonged
    to the region. conf., 0…1: how probable the word is beside the other words that the map knows. A region may fit
    badly and still be nothing else. Of a picture (--image) the confidence is the mean likeness.
    """
    import tempfile

    from ..query.conditions import Where, near_word
    from ..storage.store import load_map

    words, class_names = words or [], class_names or []
    questions = len(words) + len(class_names) + (image is not None)
    if list_classes:
        print("\n".join(load_map(map_path).vocabulary))
        return
    if interactive == bool(questions):
        raise typer.BadParameter("give words to look for, --class or --image, or --interactive without any.")
    if interactive and (ply or picture or html or refine_to is not None):
        raise typer.BadParameter(
            "--interactive answers in text or JSON: leave out --ply, --picture, --html and --refine."
        )
    if image_box is not None and image is None:
        raise typer.BadParameter("--box is a part of a picture: give --image, too.")
    if negative and questions > len(words):
        raise typer.BadParameter("--not narrows what words mean: leave it out with --class and --image.")
    if output is not None and refine_to is None:
        raise typer.BadParameter("-o keeps the map that --refine makes: give --refine METRES.")
    if views and not as_json:
        raise typer.BadParameter("--views adds to the document of --json: give both.")
    if refine_to is not None and questions > 1:
        raise typer.BadParameter("--refine looks around the best match of one word.")
    targets = [target for target in (ply, picture, html) if target is not None]
    if len(set(targets)) < len(targets):
        raise typer.BadParameter("--ply, --picture and --html are files of their own: give each another name.")
    for target in targets:
        refuse_existing(target, overwrite)
    options: dict[str, Any] = {}
    if top is not None:
        options["top_k"] = top
    if threshold is not None:
        options["threshold"] = threshold
    if scores is not None:
        options["scores"] = scores
    if any(condition is not None for condition in (within, near, on, pick)):
        word, metres = (None, Where.near_m) if near is None else near_word(near)
        options["where"] = Where(within, word, metres, on, pick)
    loaded = load_map(map_path)
    if interactive:
        _answer_lines(loaded, {**options, "negative": negative or []}, as_json, views)
        return

    def ask(scan_map: Any) -> list[Any]:
        results = scan_map.query_words(words, negative=negative or [], **options) if words else []
        results += scan_map.query_classes(class_names, **options) if class_names else []
        return results if image is None else [*results, scan_map.query_image(image, image_box, **options)]

    results = ask(loaded)
    with tempfile.TemporaryDirectory() as folder:  # for a map that nobody keeps
        if refine_to is not None and results[0].matched:
            loaded = _refined(loaded, results[0].regions[0], refine_to, output or Path(folder) / "refined", overwrite)
            results = ask(loaded)
        if ply is not None:
            from ..export.ply import write_query_ply

            write_query_ply(loaded.occupancy, results, ply, overwrite)
        if picture is not None:
            from ..viewer import map_pictures

            map_pictures.write_query_picture(loaded, results, picture, overwrite)
        if html is not None:
            from ..viewer.answer_page import write_query_page

            write_query_page(loaded, results, html, overwrite)
        print(_answer(map_path, loaded, results, as_json, views))


def _answer(map_path: Path, loaded: Any, results: list[Any], as_json: bool, views: bool) -> str:
    from ..query import word_query as asking

    if not as_json:
        unit = "" if loaded.metric else "\nLengths are not metres: the map's scale is unknown (freeocc3d scale)."
        return asking.to_text(results, loaded.metric) + unit
    from .region_details import details

    return json.dumps(asking.to_json(map_path, results, details(loaded, results, views), loaded.metric))


def _answer_lines(loaded: Any, options: dict[str, Any], as_json: bool, views: bool) -> None:
    """Answer each line of the standard input until it ends. A line that cannot be answered is told why, in JSON by a
    document with "error" in place of "results", so that every line that is not empty has its document."""
    while True:
        if sys.stdin.isatty():
            print("> ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            return
        words = [word.strip() for word in line.split(",") if word.strip()]
        if not words:
            continue
        try:
            results = loaded.query_words(words, **options)
            print(_answer(loaded.path, loaded, results, as_json, views), flush=True)
        except FreeOccError as error:
            said = " ".join(str(error).split())
            if as_json:
                print(json.dumps({"version": __version__, "map": str(loaded.path), "error": said}), flush=True)
            else:
                print(f"freeocc3d: {said}", file=sys.stderr, flush=True)


def _refined(loaded: Any, region: Any, voxel_size: float, output: Path, overwrite: bool) -> Any:
    from ..editing import box_refinement as refining

    progress = ConsoleProgress()
    box = refining.enclose_region(region, loaded.manifest["voxel_size_m"])
    try:
        return refining.refine_box(loaded, box, voxel_size, output, overwrite=overwrite, progress=progress)
    finally:
        progress.close()
