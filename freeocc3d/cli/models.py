"""``freeocc3d models``: the networks that encoders are made of."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from ..core.errors import FreeOccError, ModelError
from .console import ConsoleProgress, Json

app = typer.Typer(help="Fetch, list and verify the networks that encoders are made of.", no_args_is_help=True)


@app.command("pull")
def models_pull(
    name: Annotated[
        str, typer.Argument(metavar="NAME|REPO", help="OWNER/NAME on the Hugging Face hub, or a short one.")
    ],
    revision: Annotated[str, typer.Option("--revision", help="Branch, tag or commit.")] = "main",
) -> None:
    """Fetch a model package, or a checkpoint to export, from the Hugging Face hub."""
    from ..language import model_hub

    progress = ConsoleProgress()
    try:
        folder = model_hub.pull(name, revision, progress)
    finally:
        progress.close()
    if folder.parent.name == model_hub.CHECKPOINTS:
        print(f"{folder}: a checkpoint, to be exported: python tools/export_encoder.py {folder} -o {folder.name}")
    else:
        print(folder)


@app.command("list")
def models_list(as_json: Json = False) -> None:
    """List the models in the models folder."""
    from ..language import model_packages

    found = model_packages.installed()
    if as_json:
        facts = {
            name: {"error": str(p)}
            if isinstance(p, FreeOccError)
            else {"kind": p.kind, "dimension": p.dimension, "precision": p.precision, "bytes": p.bytes,
                  "licence": p.licence, "source": p.source}
            for name, p in found.items()
        }  # fmt: skip
        print(json.dumps({"folder": str(model_packages.models_folder()), "models": facts}))
        return
    for name, package in found.items():
        if isinstance(package, FreeOccError):
            print(f"{name:<24} unusable: {package}")
        else:
            print(
                f"{name:<24} {package.kind:<9} {package.dimension:>5} dimensions  {package.precision}  "
                f"{package.bytes / 1e6:8.1f} MB  licence {package.licence}, from {package.source}"
            )
    if not found:
        print(f"There are no models in {model_packages.models_folder()}.")


@app.command("verify")
def models_verify(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME|FOLDER]...", help="[default: all]")] = None,
) -> None:
    """Compare the content of every file with the hash in its model's manifest."""
    from ..language import model_packages

    folders = [path if (path := Path(name)).is_dir() else model_packages.models_folder() / name for name in names or []]
    damaged = []
    for folder in folders or [model_packages.models_folder() / name for name in model_packages.installed()]:
        try:
            package = model_packages.read(folder)
            model_packages.verify(package)
        except ModelError as error:
            damaged.append(str(error))
        else:
            print(f"{folder}: {len(package.files)} files are as they should be")
    if damaged:
        raise ModelError(" ".join(damaged))
