"""``freeocc3d objects``: the things of a room, as a table, a document, a page or a picture. Heavy imports happen
inside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .. import __version__
from ..core.atomic_files import refuse_existing
from ..core.errors import FreeOccError
from .console import Json, MapPath, Overwrite, show, show_document

if TYPE_CHECKING:
    from ..query.objects.object import Object
    from ..query.objects.relations import Relation
    from ..query.scan_map import Map

_LONGEST_NAME = 28


def objects(
    map_path: MapPath,
    class_names: Annotated[
        list[str] | None,
        typer.Option("--class", metavar="NAME", help="Only objects with this name, or a kind of it; repeatable."),
    ] = None,
    masks: Annotated[
        str | None,
        typer.Option("--masks", metavar="NAME", help="Model whose masks of keyframes tell things apart; see models."),
    ] = None,
    as_json: Json = False,
    html: Annotated[
        Path | None,
        typer.Option("--html", metavar="OUT.html", help="Write a page with a plan, and the best image of each object."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="OUT.png", help="Draw the objects from above, with numbers.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """List the things of the room.

    Each has a number, a name with its probability, an upright box, the keyframe that shows it best, and how it stands
    to others: on, in or next to another object, or against a wall.
    """
    from ..query.scan_map import load_map

    files = [path for path in (html, picture) if path is not None]
    if len(set(files)) < len(files):
        raise typer.BadParameter("give --html and --picture different file names.")
    for target in files:
        refuse_existing(target, overwrite)
    loaded = load_map(map_path)
    found = loaded.objects(masks=masks) if masks is not None else loaded.objects()
    relations = loaded.relations_of(found)
    shown = _chosen(found, class_names or [])
    if picture is not None:
        from ..viewer.object_pictures import write_objects_picture

        write_objects_picture(loaded, found, shown, picture, overwrite)
    if html is not None:
        from ..viewer.objects_page import write_objects_page

        write_objects_page(loaded, found, relations, shown, html, overwrite)
    if as_json:
        show_document(objects_document(loaded, found, relations, shown))
    else:
        show(*objects_lines(loaded, found, relations, shown))


def _chosen(found: Sequence[Object], names: Sequence[str]) -> list[int]:
    """Returns the rows of the objects with one of the names, all without names. Raises FreeOccError for a name that no
    object has."""
    from ..language.class_names import match_names

    if not names:
        return list(range(len(found)))
    known = list(dict.fromkeys(thing.name for thing in found))
    meant = set()
    for name in names:
        rows, _ = match_names(name, known)
        if not rows:
            told = ", ".join(sorted(known)) or "nothing"
            raise FreeOccError(f"The map has no object with the name '{name}'. Its objects are: {told}.")
        meant |= {known[row] for row in rows}
    return [row for row, thing in enumerate(found) if thing.name in meant]


def objects_document(
    loaded: Map, found: Sequence[Object], relations: Sequence[Sequence[Relation]], shown: Sequence[int]
) -> dict[str, Any]:
    """What ``objects --json`` prints. shown: rows of the objects in it; relations may name others."""
    from ..query.objects.description import describe_objects

    every = describe_objects(found, relations)
    return {
        "version": __version__,
        "map": str(loaded.path),
        "metric": loaded.metric,
        "frame": "map",
        "objects": [every[row] for row in shown],
    }


def objects_lines(
    loaded: Map, found: Sequence[Object], relations: Sequence[Sequence[Relation]], shown: Sequence[int]
) -> list[str]:
    """What ``objects`` prints for people."""
    from ..query.objects.description import tell_relations

    count = f"{len(found)} object{'' if len(found) == 1 else 's'}"
    if len(shown) < len(found):
        count = f"{len(shown)} of {count}"
    if not found:
        return ["No objects were found."]
    unit = "m" if loaded.metric else "units"
    rows = [("#", "name", "prob.", f"size ({unit})", f"center ({unit})", "frame", "relations")]
    for row in shown:
        thing = found[row]
        rows.append(
            (
                str(row + 1),
                thing.name if len(thing.name) <= _LONGEST_NAME else f"{thing.name[: _LONGEST_NAME - 1]}…",
                f"{thing.names[0][1]:.2f}" if thing.names else "-",
                " x ".join(f"{edge:.2f}" for edge in thing.box.extent),
                " ".join(f"{value:6.2f}" for value in thing.centroid),
                str(thing.keyframes[0].frame) if thing.keyframes else "-",
                ", ".join(tell_relations(found, relations[row])),
            )
        )
    widths = [max(len(cells[column]) for cells in rows) for column in range(len(rows[0]))]
    right = (0, 2, 4, 5)
    lines = [
        "  ".join(f"{text:{'>' if column in right else '<'}{widths[column]}}" for column, text in enumerate(cells))
        for cells in rows
    ]
    note = "The map's scale is unknown, so lengths are not meters (see freeocc3d scale)."
    return [f"{count}.", *(line.rstrip() for line in lines), *([] if loaded.metric else [note])]
