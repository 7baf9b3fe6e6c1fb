"""``freeocc3d reconstruct``: turns a captured scan into a map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core.errors import ConfigError
from .console import ConsoleProgress, NewMap, Overwrite, Set, flag, show
from .map_summary import summary_lines
from .words import Words, obtain_words

if TYPE_CHECKING:
    from ..settings.config import Settings

_MOVABLE = ("tracking", "fitting")
"""Sections whose backends may have an option ``device``."""


def reconstruct(
    capture: Annotated[str, typer.Argument(metavar="CAPTURE", help="Folder of a scan, a video file, or builtin:room.")],
    output: NewMap,
    config_file: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE|NAME", help="YAML file with options, or a preset such as mono."),
    ] = None,
    overrides: Set = None,
    words: Words = None,
    resume: Annotated[bool, flag("--resume", "Continue an interrupted run.")] = False,
    overwrite: Overwrite = False,
    device: Annotated[
        str | None,
        typer.Option("--device", metavar="DEVICE", help="Device to compute on: cpu or cuda:0.", show_default="cpu"),
    ] = None,
    focal: Annotated[
        float | None,
        typer.Option("--focal", metavar="PX", help="Focal length of the color images, pixels, if nothing states it."),
    ] = None,
    scale: Annotated[
        float | None,
        typer.Option("--scale", metavar="S", help="Meters per unit of the poses, for scans without depth."),
    ] = None,
) -> None:
    """Turn a captured scan into a map."""
    from ..language.word_models import use_package
    from ..pipeline import run
    from ..settings import config

    given = {"scale": scale, "focal": focal}
    of_flags = [f"capture.{name}={value}" for name, value in given.items() if value is not None]
    settings = config.load(config_file, [*(overrides or []), *of_flags])
    if device is not None:
        settings = _move(settings, device)
    with ConsoleProgress() as progress:
        if words is not None:
            settings = use_package(settings, obtain_words(words, progress))
        made = run.reconstruct(capture, output, settings, overwrite=overwrite, resume=resume, progress=progress)
    show(*summary_lines(made))


def _move(settings: Settings, device: str) -> Settings:
    """The settings with a device for the backends that can use one. Raises ConfigError if there is none."""
    movable = [section for section in _MOVABLE if settings.has_backend_option(section, "device")]
    if device != "cpu" and not movable:
        raise ConfigError(
            f"No chosen backend runs on {device}: choose fitting.rasterizer=gsplat or tracking.backend=odometry."
        )
    for section in movable:
        settings = settings.with_backend(section, device=device)
    return settings
