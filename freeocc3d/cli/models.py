"""``freeocc3d models``: the networks that encoders use."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import FreeOccError, ModelError, printable
from .console import ConsoleProgress, Json, flag, show, show_document
from .option_groups import grouped

Precision = Literal["fp32", "fp16", "int8"]

app = typer.Typer(help="Fetch, export, list, verify and remove the networks that encoders use.", no_args_is_help=True)


@app.command("pull")
def models_pull(
    name: Annotated[
        str,
        typer.Argument(metavar="words|masks|NAME|REPO", help="A short name, or OWNER/NAME on the Hugging Face hub."),
    ],
    revision: Annotated[str, typer.Option("--revision", metavar="NAME", help="Branch, tag or commit.")] = "main",
    precision: Annotated[
        Precision | None,
        typer.Option("--precision", help="Of a ready-made ONNX export; int8 is the smallest.", show_default="int8"),
    ] = None,
) -> None:
    """Fetch a model from the Hugging Face hub: "words" is the recommended
    one for any words, "masks" the one that tells things apart for objects.

    A ready-made ONNX export becomes a model package, without torch; so do
    clip-b16, clip-b32, siglip-b16 and siglip2-b16. A repository with a
    model package is taken as it is. A checkpoint is fetched for export.
    """
    from ..language import model_hub

    with ConsoleProgress() as progress:
        folder = model_hub.pull_package(name, revision, progress, precision)
    if folder.parent.name == model_hub.CHECKPOINTS:
        show(f"{folder}: a checkpoint; export it: freeocc3d models export {folder} -o {folder.name}")
    else:
        show(str(folder))


@dataclass(frozen=True)
class WordSide:
    """Where words come from."""

    tokenizer: Annotated[
        Path | None,
        typer.Option("--tokenizer", metavar="FOLDER", help="Folder of the tokenizer, if it is not CHECKPOINT."),
    ] = None
    text: Annotated[
        str | None,
        typer.Option(
            "--text",
            metavar="FOLDER",
            help="Weights of dino.txt for a DINO, or with --text-head the CLIP for a DINOv2.",
        ),
    ] = None
    text_head: Annotated[
        Path | None,
        typer.Option(
            "--text-head", metavar="FILE", help="With --text: safetensors file with the projection of Talk2DINO."
        ),
    ] = None


@app.command("export")
@grouped
def models_export(
    checkpoint: Annotated[
        str,
        typer.Argument(
            metavar="CHECKPOINT",
            help="Folder of a checkpoint of CLIP, SigLIP, DINO, RADIO or SAM, OWNER/NAME on the Hugging Face hub, or "
            "open_clip:ARCHITECTURE/WEIGHTS.",
        ),
    ],
    output: Annotated[
        str,
        typer.Option(
            "-o",
            "--output",
            metavar="NAME",
            help="Folder to write. A name without a slash is a folder of the models folder.",
        ),
    ],
    word_side: WordSide,
    precision: Annotated[
        Precision, typer.Option("--precision", help="Precision of the weights; fp16 and int8 are smaller and faster.")
    ] = "fp32",
    license_name: Annotated[
        str | None,
        typer.Option(
            "--license",
            "--licence",
            metavar="NAME",
            help="License of the weights, if the model card does not state it.",
        ),
    ] = None,
) -> None:
    """Turn a checkpoint into a model package: ONNX networks, tokenizer and manifest.

    CHECKPOINT holds config.json with model.safetensors,
    open_clip_config.json with open_clip_model.safetensors, or PE-….safetensors.
    Words also need tokenizer.json, or vocab.json with merges.txt.
    Weights are read from safetensors files only.
    """
    from ..language.model_export.export_checkpoint import export_checkpoint

    if word_side.text is None and word_side.text_head is not None:
        raise typer.BadParameter("--text-head needs --text.")
    made = export_checkpoint(
        checkpoint, output, precision, word_side.tokenizer, word_side.text, word_side.text_head, license_name
    )
    show(f"{made.folder}: {made.kind}, {made.dimension} dimensions, {made.precision}, {made.bytes:,} bytes")


@app.command("list")
def models_list(
    available: Annotated[
        bool, typer.Option("--available", help="Models with a short name too, and seconds to encode a keyframe here.")
    ] = False,
    as_json: Json = False,
) -> None:
    """List the models in the models folder."""
    from ..language import model_packages

    rows = _available_models() if available else _installed_models()
    if as_json:
        show_document({"folder": str(model_packages.find_models_folder()), "models": rows})
        return
    for name, facts in rows.items():
        show(f"{name:<24} unusable: {facts['error']}" if "error" in facts else f"{name:<24} {_described(facts)}")
    if not rows:
        show(f"There are no models in {model_packages.find_models_folder()}.")


def _installed_models() -> dict[str, dict[str, Any]]:
    """Name -> facts of the models in the models folder."""
    from ..language import model_packages

    return {
        name: {"error": str(package)}
        if isinstance(package, FreeOccError)
        else {"kind": package.kind, "dimension": package.dimension, "precision": package.precision,
              "bytes": package.bytes, "licence": package.licence, "source": package.source}
        for name, package in model_packages.list_installed().items()
    }  # fmt: skip


def _available_models() -> dict[str, dict[str, Any]]:
    """Name -> facts of installed models and of those with a short name, with seconds to encode a keyframe."""
    from ..language import encoding_speed, known_models, model_packages

    rows = _installed_models()
    for name, facts in rows.items():
        if "error" not in facts:
            package = model_packages.read_package(model_packages.find_models_folder() / name)
            facts |= {"installed": True, "seconds": encoding_speed.measure_frame(package), "estimated": False}
    speed = encoding_speed.measure_products()
    for name, known in known_models.KNOWN.items():
        rows.setdefault(name, {
            "kind": "export" if known.export else "checkpoint", "dimension": known.dimension,
            "precision": known.precision, "bytes": known.megabytes * 1_000_000,
            "licence": known.licence, "source": known.repository, "installed": False,
            "seconds": 1e9 * known.gigaflop / speed, "estimated": True,
        })  # fmt: skip
    return rows


def _described(facts: dict[str, Any]) -> str:
    """A model in a line."""
    line = (
        f"{facts['kind']:<10} {facts['dimension']:>5} dimensions  {facts['precision']}  "
        f"{facts['bytes'] / 1e6:8.1f} MB  license {facts['licence']}, from {facts['source']}"
    )
    if facts.get("seconds") is not None:
        how = "estimated" if facts["estimated"] else "measured"
        line += f"; {facts['seconds']:.1f} s a keyframe ({how})"
    if facts.get("kind") == "checkpoint":
        line += "; needs 'freeocc3d models export', with torch"
    return line


@app.command("verify")
def models_verify(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME|FOLDER", help="Model packages.", show_default="all")
    ] = None,
) -> None:
    """Compare the content of every file with the hash in its model's manifest."""
    from ..language import model_packages

    folders = [
        path if (path := Path(name)).is_dir() else model_packages.find_models_folder() / name for name in names or []
    ]
    damaged = []
    for folder in folders or [model_packages.find_models_folder() / name for name in model_packages.list_installed()]:
        try:
            package = model_packages.read_package(folder)
            model_packages.verify_files(package)
        except ModelError as error:
            damaged.append(str(error))
        else:
            show(f"{folder}: {len(package.files)} files match their hashes")
    if damaged:
        raise ModelError(" ".join(damaged))


@app.command("remove")
def models_remove(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a model: see 'freeocc3d models list'.")],
    yes: Annotated[bool, flag("--yes", "Do not ask.")] = False,
    as_json: Json = False,
) -> None:
    """Remove a model from the models folder: its package, its checkpoint, and what is fetched of them.

    A map with its words needs the model again to be asked.
    """
    from ..language import model_removal

    found = model_removal.find_removable(name)
    what = f"{', '.join(map(str, found.folders))} ({found.bytes / 1e6:.1f} MB)"
    if not yes:
        if not (sys.stdin.isatty() and sys.stderr.isatty()):
            raise ModelError(f"This removes {what}: add --yes if it shall.")
        if not typer.confirm(f"Remove {printable(what)}?", default=False, err=True):
            raise ModelError(f"The model '{name}' is kept.")
    model_removal.remove(found)
    if as_json:
        show_document({"removed": [str(folder) for folder in found.folders], "bytes": found.bytes})
    else:
        show(f"removed {what}")
