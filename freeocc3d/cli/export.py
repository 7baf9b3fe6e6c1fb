"""``freeocc3d export``: a map in another program's format."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from ..core.atomic_files import refuse_existing
from ..core.errors import ConfigError
from .console import ConsoleProgress, MapPath, Overwrite, Set


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
            help="map, gravity (z up, floor at 0) or first-camera (z up, origin there).",
            show_default="the format's own",
        ),
    ] = None,
    overrides: Set = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a map in another program's format."""
    from ..export import export_map
    from ..settings import registry
    from ..storage.store import load_map

    known = registry.backend("export", format_name).options
    options = {} if frame is None else {"frame": frame}
    options |= parsed_options(overrides or [], {option.name: option.type for option in known})
    refuse_existing(output, overwrite)
    progress, loaded = ConsoleProgress(), load_map(map_path)
    for note in export_map(loaded, format_name, output, options, overwrite=overwrite):
        progress.warn(note)
    if not loaded.metric:
        print("note: the map's scale is unknown, so lengths are not metres (see freeocc3d scale).", file=sys.stderr)
    files = [path for path in output.rglob("*") if path.is_file()] if output.is_dir() else [output]
    print(f"{output}: {sum(path.stat().st_size for path in files):,} bytes")


def parsed_options(overrides: list[str], types: dict[str, str]) -> dict[str, Any]:
    """Options from name=value, where values are YAML and lists need no brackets. types: of the options, as written in
    their class. Raises ConfigError."""
    import yaml

    values = {}
    for override in overrides:
        name, separator, text = (part.strip() for part in override.partition("="))
        if not separator:
            raise ConfigError(f"An option has the form name=value, got '{override}'.")
        kind = types.get(name, "")
        bare = [part.strip() for part in text.split(",")] if kind.startswith("tuple[") and text[:1] != "[" else None
        try:
            if bare is None:
                values[name] = yaml.safe_load(text)
            else:
                values[name] = bare if "str" in kind else [yaml.safe_load(part) for part in bare]
        except yaml.YAMLError as error:
            raise ConfigError(f"The value of '{name}' is not valid YAML: '{text}'.") from error
    return values
