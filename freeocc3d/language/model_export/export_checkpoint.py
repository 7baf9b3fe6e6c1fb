"""Exports a checkpoint as a model package, for ``freeocc3d models export``."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from ...core.errors import DependencyError
from .. import model_packages
from ..package_files import stated_licence

_NEEDED = ("onnx", "onnxscript", "safetensors", "tokenizers", "transformers")


def export_checkpoint(
    source: str,
    output: str,
    precision: model_packages.Precision = "fp32",
    tokenizer: Path | None = None,
    text: str | None = None,
    text_head: Path | None = None,
    licence: str | None = None,
) -> model_packages.Package:
    """Writes the checkpoint as a model package, and reads it back.

    source: a folder with config.json and model.safetensors (CLIP, SigLIP, DINO, SAM of transformers, RADIO), with
    open_clip_config.json and open_clip_model.safetensors, or with PE-….safetensors (Perception Encoder),
    ``open_clip:ARCHITECTURE/WEIGHTS``, or OWNER/NAME on the Hugging Face hub.
    output: the folder to write; a plain name means a folder in the models folder.
    tokenizer: folder with tokenizer.json, or vocab.json and merges.txt, if the checkpoint has neither.
    text: folder with dino.txt's weights for a DINO as safetensors files, checkpoint of the SigLIP 2 of a RADIO, or of
    the CLIP whose words are projected into the space of a DINOv2.
    text_head: the safetensors file of that projection, Talk2DINO's.
    licence: license of the weights; None = the one on the model card.

    Raises ModelError if the checkpoint does not exist or the folder exists, DependencyError if a package is missing.
    """
    if missing := [name for name in _NEEDED if find_spec(name) is None]:
        raise DependencyError(
            f"Exporting a model needs {', '.join(missing)}: install with pip install 'freeocc3d[export]'."
        )
    from .checkpoint_files import read_checkpoint
    from .package_writer import write_package

    folder = model_packages.find_models_folder() / output if Path(output).name == output else Path(output)
    checkpoint = read_checkpoint(source, tokenizer, text, text_head)
    write_package(checkpoint, folder, folder.name, source, licence or stated_licence(Path(source)), precision)
    return model_packages.read_package(folder)
