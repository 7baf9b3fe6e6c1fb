"""``freeocc3d export``: a map in another program's format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..core.atomic_files import refuse_existing
from .console import ConsoleProgress, MapPath, Overwrite, Set, say, show


def export(
    map_path: MapPath,
    format_name: Annotated[
        str, typer.Option("--format", metavar="NAME", help="Name of the format: see 'freeocc3d list exporters'.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="File or folder to write.")],
    frame: Annotated[
        str | None,
        typer.Option(
            "--frame",
            metavar="FRAME",
            help="gravity (z up, floor at 0), map, start (z up, origin at the first camera) or first-camera (its own).",
            show_default="the format's own",
        ),
    ] = None,
    overrides: Set = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a map in another program's format."""
    from ..export import export_map
    from ..query.scan_map import load_map
    from ..settings import registry
    from ..settings.yaml_files import named_values

    known = registry.backend("export", format_name).options
    options: dict[str, Any] = {} if frame is None else {"frame": frame}
    options |= named_values(overrides or [], {option.name: option.kind for option in known})
    refuse_existing(output, overwrite)
    progress, loaded = ConsoleProgress(), load_map(map_path)
    for note in export_map(loaded, format_name, output, options, overwrite=overwrite):
        progress.warn(note)
    if not loaded.metric:
        say("note: the map's scale is unknown, so lengths are not meters (see freeocc3d scale).")
    files = [path for path in output.rglob("*") if path.is_file()] if output.is_dir() else [output]
    show(f"{output}: {sum(path.stat().st_size for path in files):,} bytes")
