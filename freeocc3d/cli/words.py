"""The model that ``--words`` names: an installed one, or one that is fetched."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

import typer

from ..core.errors import ModelError
from ..core.progress import Progress

if TYPE_CHECKING:
    from ..language.model_packages import Package

WordsHelp = (
    "Model of any words, fetched if it is missing: words, clip-b16, siglip2-b16, OWNER/NAME, or an installed one."
)
Words = Annotated[str | None, typer.Option("--words", metavar="NAME", help=WordsHelp)]


def obtain_words(name: str, progress: Progress) -> Package:
    """The package with that name; fetches it if it is not installed. On a terminal the user is asked before. Raises
    ModelError."""
    from ..language import known_models, model_hub, model_packages, word_models

    found = word_models.find_words(name)
    if found is not None:
        return found
    if sys.stdin.isatty() and sys.stderr.isatty() and not model_hub.is_offline():
        repository = known_models.NAMES.get(model_hub.local_name(name), name)
        if not typer.confirm(f"The model '{name}' is not installed. Fetch {repository}?", default=True, err=True):
            raise ModelError(f"The model '{name}' is not installed: fetch it with 'freeocc3d models pull {name}'.")
    folder = model_hub.pull_package(name, progress=progress)
    if folder.parent.name == model_hub.CHECKPOINTS:
        raise ModelError(f"{name} is a checkpoint: export it with 'freeocc3d models export {folder} -o {folder.name}'.")
    return model_packages.read_package(folder)
