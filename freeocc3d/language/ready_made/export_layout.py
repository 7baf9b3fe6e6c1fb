"""The layout of ready-made ONNX exports of CLIP and SigLIP.

    config.json  preprocessor_config.json  tokenizer.json
    onnx/vision_model.onnx  onnx/text_model.onnx           … or …_fp16.onnx, …_quantized.onnx

transformers.js fixed the layout, and ``optimum`` writes the graphs: ``pixel_values`` to ``image_embeds``, ``input_ids``
to ``text_embeds``; for SigLIP both give ``pooler_output``.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec

from ...core.errors import DependencyError, ModelError
from ..model_packages import Precision

FOLDER = "onnx/"
"""Folder of the graphs, in a repository."""

DOCUMENTS = ("config.json", "preprocessor_config.json", "tokenizer.json")

SUFFIXES: dict[Precision, str] = {"fp32": "", "fp16": "_fp16", "int8": "_quantized"}
"""Precision -> what the names of its graphs end with."""

LARGEST_TOKENIZER = 64 << 20
"""Bytes; SigLIP 2's tokenizer, of 256,000 tokens, has 34 MB."""

NEEDED = ("onnx", "tokenizers")
"""Packages that make a model package of an export."""


def graph_names(precision: Precision) -> tuple[str, str]:
    """The vision and the text graph of a precision, as paths in the repository."""
    suffix = SUFFIXES[precision]
    return f"{FOLDER}vision_model{suffix}.onnx", f"{FOLDER}text_model{suffix}.onnx"


def choose_files(
    repository: str, sizes: Mapping[str, int], precision: Precision | None
) -> tuple[Precision, list[str]] | None:
    """The precision and the files to fetch of a repository with a ready-made export; None if it has no graphs.

    sizes: file -> bytes.  precision: None = int8, or else the first that exists. Raises ModelError for an export that
    lacks files or is laid out otherwise, and DependencyError if a package is missing that reads it.
    """
    graphs = {known: graph_names(known) for known in SUFFIXES}
    found = [known for known, names in graphs.items() if set(names) <= set(sizes)]
    if not found:
        if others := sorted(name for name in sizes if name.startswith(FOLDER)):
            raise ModelError(
                f"{repository} is laid out otherwise than the exports that can be used: it has "
                f"{', '.join(others)[:200]}, but not {' and '.join(graphs['fp32'])}."
            )
        return None
    if precision and precision not in found:
        raise ModelError(f"{repository} has no graphs of {precision}, only of {', '.join(found)}.")
    chosen = precision or ("int8" if "int8" in found else found[0])
    if lacking := [file for file in DOCUMENTS if file not in sizes]:
        raise ModelError(f"{repository} lacks {', '.join(lacking)}, which its graphs need.")
    if (size := sizes["tokenizer.json"]) > LARGEST_TOKENIZER:
        raise ModelError(
            f"tokenizer.json of {repository} has {size:,} bytes, more than the {LARGEST_TOKENIZER:,} that are read: it "
            "is not fetched."
        )
    if missing := [package for package in NEEDED if find_spec(package) is None]:
        raise DependencyError(
            f"Reading {repository} needs {', '.join(missing)}: install with pip install 'freeocc3d[words]'."
        )
    optional = ["README.md", *(f"{graph}_data" for graph in graphs[chosen])]
    return chosen, [*(file for file in optional if file in sizes), *DOCUMENTS, *graphs[chosen]]
