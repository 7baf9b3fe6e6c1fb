"""``freeocc3d list``: readers, trackers, encoders and exporters with their options."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from .console import Json, flag, show, show_document

if TYPE_CHECKING:
    from ..settings.registry import Backend


def list_backends(
    kind: Annotated[
        str | None,
        typer.Argument(metavar="KIND", help="Only these: readers, trackers, rasterizers, encoders, exporters."),
    ] = None,
    as_json: Json = False,
    as_yaml: Annotated[bool, flag("--yaml", "Print a configuration file that explains every key.")] = False,
    advanced: Annotated[
        bool, flag("--advanced", "Also show the options that only comparisons with other methods need.")
    ] = False,
) -> None:
    """List readers, trackers, encoders and exporters with their options."""
    from ..settings import registry
    from ..settings.default_yaml import default_yaml

    if as_yaml:
        show(*default_yaml().splitlines())
        return
    folders = registry.FOLDERS if kind is None else [registry.folder_of(kind)]
    found = {registry.FOLDERS[folder]: registry.backends(folder).values() for folder in folders}
    if as_json:
        show_document({title: {b.name: _facts(b) for b in backends} for title, backends in found.items()})
        return
    for title, backends in found.items():
        show(f"{title}s", *_lines(backends, advanced))


def _facts(backend: Backend) -> dict[str, object]:
    """The JSON document of a backend, with all its options."""
    options = {
        o.name: {"type": o.type, "default": o.default, "doc": o.doc, "advanced": o.advanced} for o in backend.options
    }
    return {"summary": backend.summary, "missing": backend.missing, "options": options}


def _lines(backends: Iterable[Backend], advanced: bool) -> Iterator[str]:
    for backend in backends:
        missing = f"  [needs {', '.join(backend.missing)}]" if backend.missing else ""
        yield f"  {backend.name:<14} {backend.summary}{missing}"
        for option in backend.options:
            if advanced or not option.advanced:
                yield f"      {option.name} = {option.default!r}  ({option.type}) {option.doc}"
        hidden = sum(option.advanced for option in backend.options)
        if hidden and not advanced:
            yield f"      ({hidden} more with --advanced)"
