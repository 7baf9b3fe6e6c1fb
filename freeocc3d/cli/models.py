"""``freeocc3d models``: the networks that encoders use."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from ..core.errors import FreeOccError, ModelError
from .console import ConsoleProgress, Json
from .option_groups import grouped

Precision = Literal["fp32", "fp16", "int8"]

app = typer.Typer(help="Fetch, export, list and verify the networks that encoders use.", no_args_is_help=True)


@app.command("pull")
def models_pull(
    name: Annotated[
        str, typer.Argument(metavar="words|NAME|REPO", help="A short name, or OWNER/NAME on the Hugging Face hub.")
    ],
    revision: Annotated[str, typer.Option("--revision", metavar="NAME", help="Branch, tag or commit.")] = "main",
    precision: Annotated[
        Precision | None,
        typer.Option("--precision", help="Of a ready-made ONNX export; int8 is the smallest.", show_default="int8"),
    ] = None,
) -> None:
    """Fetch a model from the Hugging Face hub: "words" is the recommended
    one for any words.

    A ready-made ONNX export becomes a model package, without torch; so do
    clip-b16, clip-b32, siglip-b16 and siglip2-b16. A repository with a
    model package is taken as it is. A checkpoint is fetched for export.
    """
    from ..language import model_hub

    with ConsoleProgress() as progress:
        folder = model_hub.pull_package(name, revision, progress, precision)
    if folder.parent.name == model_hub.CHECKPOINTS:
        print(f"{folder}: a checkpoint; export it: freeocc3d models export {folder} -o {folder.name}")
    else:
        print(folder)


@dataclass(frozen=True)
class WordSide:
    """Where words come from."""

    tokenizer: Annotated[
        Path | None,
        typer.Option("--tokenizer", metavar="FOLDER", help="Folder of the tokenizer, if it is not CHECKPOINT."),
    ] = None
    text: Annotated[
        str | None, typer.Option("--text", metavar="CLIP", help="Checkpoint of the CLIP that reads words for a DINOv2.")
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
            help="Folder of a checkpoint of CLIP, SigLIP, DINO, DINOv2 or SAM, OWNER/NAME on the Hugging Face hub, or "
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

    CHECKPOINT holds config.json with model.safetensors, or
    open_clip_config.json with open_clip_model.safetensors.
    Words also need tokenizer.json, or vocab.json with merges.txt.
    Weights are read from safetensors files only.
    """
    from ..language.model_export.export_checkpoint import export_checkpoint

    if (word_side.text is None) != (word_side.text_head is None):
        raise typer.BadParameter("give --text and --text-head together.")
    made = export_checkpoint(
        checkpoint, output, precision, word_side.tokenizer, word_side.text, word_side.text_head, license_name
    )
    print(f"{made.folder}: {made.kind}, {made.dimension} dimensions, {made.precision}, {made.bytes:,} bytes")


@app.command("list")
def models_list(as_json: Json = False) -> None:
    """List the models in the models folder."""
    from ..language import model_packages

    found = model_packages.list_installed()
    if as_json:
        facts = {
            name: {"error": str(p)}
            if isinstance(p, FreeOccError)
            else {"kind": p.kind, "dimension": p.dimension, "precision": p.precision, "bytes": p.bytes,
                  "licence": p.licence, "source": p.source}
            for name, p in found.items()
        }  # fmt: skip
        print(json.dumps({"folder": str(model_packages.find_models_folder()), "models": facts}))
        return
    for name, package in found.items():
        if isinstance(package, FreeOccError):
            print(f"{name:<24} unusable: {package}")
        else:
            print(
                f"{name:<24} {package.kind:<9} {package.dimension:>5} dimensions  {package.precision}  "
                f"{package.bytes / 1e6:8.1f} MB  license {package.licence}, from {package.source}"
            )
    if not found:
        print(f"There are no models in {model_packages.find_models_folder()}.")


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
            print(f"{folder}: {len(package.files)} files match their hashes")
    if damaged:
        raise ModelError(" ".join(damaged))
