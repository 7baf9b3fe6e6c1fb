"""``freeocc3d list``: readers, trackers, encoders and exporters with their options."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from .console import Json, flag


def list_backends(
    kind: Annotated[
        str | None,
        typer.Argument(metavar="KIND", help="Only these: readers, trackers, rasterizers, encoders, exporters."),
    ] = None,
    as_json: Json = False,
    as_yaml: Annotated[bool, flag("--yaml", "Print a configuration file that explains every key.")] = False,
) -> None:
    """List readers, trackers, encoders and exporters with their options."""
    from ..settings import config, registry

    if as_yaml:
        print(config.documented(), end="")
        return

    folders = registry.FOLDERS if kind is None else [registry.folder_of(kind)]
    found = {registry.FOLDERS[folder]: registry.backends(folder) for folder in folders}
    if as_json:
        print(
            json.dumps(
                {
                    title: {
                        b.name: {
                            "summary": b.summary,
                            "missing": b.missing,
                            "options": {
                                o.name: {"type": o.type, "default": o.default, "doc": o.doc} for o in b.options
                            },
                        }
                        for b in backends.values()
                    }
                    for title, backends in found.items()
                }
            )
        )
        return
    for title, backends in found.items():
        print(f"{title}s")
        for backend in backends.values():
            missing = f"  [needs {', '.join(backend.missing)}]" if backend.missing else ""
            print(f"  {backend.name:<14} {backend.summary}{missing}")
            for option in backend.options:
                print(f"      {option.name} = {option.default!r}  ({option.type}) {option.doc}")
