"""The layouts of ready-made ONNX exports of CLIP and SigLIP, and of SAM and SAM 2.

    config.json  preprocessor_config.json  tokenizer.json
    onnx/vision_model.onnx  onnx/text_model.onnx           … or …_fp16.onnx, …_quantized.onnx

    preprocessor_config.json
    onnx/vision_encoder.onnx  onnx/prompt_encoder_mask_decoder.onnx                    … same

transformers.js fixed the layouts, and ``optimum`` writes the graphs: ``pixel_values`` to ``image_embeds``,
``input_ids`` to ``text_embeds``; for SigLIP both give ``pooler_output``. For SAM see ``mask_packages``.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec

from ...core.errors import DependencyError, ModelError
from ..model_packages import Precision

FOLDER = "onnx/"
"""Folder of the graphs, in a repository."""

WORD_GRAPHS, MASK_GRAPHS = ("vision_model", "text_model"), ("vision_encoder", "prompt_encoder_mask_decoder")
"""The two graphs of an export, without their precision and suffix."""

_DOCUMENTS = {
    WORD_GRAPHS: ("config.json", "preprocessor_config.json", "tokenizer.json"),
    MASK_GRAPHS: ("preprocessor_config.json",),
}

SUFFIXES: dict[Precision, str] = {"fp32": "", "fp16": "_fp16", "int8": "_quantized"}
"""Precision -> what the names of its graphs end with."""

LARGEST_TOKENIZER = 64 << 20
"""Bytes; SigLIP 2's tokenizer, of 256,000 tokens, has 34 MB."""

NEEDED = ("onnx", "tokenizers")
"""Packages that make a model package of an export."""


def graph_names(graphs: tuple[str, str], precision: Precision) -> tuple[str, str]:
    """The two graphs of a precision, as paths in the repository."""
    first, second = (f"{FOLDER}{graph}{SUFFIXES[precision]}.onnx" for graph in graphs)
    return first, second


def choose_files(
    repository: str, sizes: Mapping[str, int], precision: Precision | None
) -> tuple[Precision, list[str]] | None:
    """The precision and the files to fetch of a repository with a ready-made export; None if it has no graphs.

    sizes: file -> bytes.  precision: None = int8, or else the first that exists. Raises ModelError for an export that
    lacks files or is laid out otherwise, and DependencyError if a package is missing that reads it.
    """
    by_layout = {layout: _precisions(layout, sizes) for layout in _DOCUMENTS}
    layout = next((layout for layout, found in by_layout.items() if found), None)
    if layout is None:
        if others := sorted(name for name in sizes if name.startswith(FOLDER)):
            raise ModelError(
                f"{repository} is laid out otherwise than the exports that can be used: it has "
                f"{', '.join(others)[:200]}, but not {' and '.join(graph_names(WORD_GRAPHS, 'fp32'))}, nor "
                f"{' and '.join(graph_names(MASK_GRAPHS, 'fp32'))}."
            )
        return None
    found, documents = by_layout[layout], _DOCUMENTS[layout]
    if precision and precision not in found:
        raise ModelError(f"{repository} has no graphs of {precision}, only of {', '.join(found)}.")
    chosen = precision or ("int8" if "int8" in found else found[0])
    if lacking := [file for file in documents if file not in sizes]:
        raise ModelError(f"{repository} lacks {', '.join(lacking)}, which its graphs need.")
    if (size := sizes.get("tokenizer.json", 0)) > LARGEST_TOKENIZER:
        raise ModelError(
            f"tokenizer.json of {repository} has {size:,} bytes, more than the {LARGEST_TOKENIZER:,} that are read: it "
            "is not fetched."
        )
    if missing := [package for package in NEEDED if find_spec(package) is None]:
        raise DependencyError(
            f"Reading {repository} needs {', '.join(missing)}: install with pip install 'freeocc3d[words]'."
        )
    graphs = graph_names(layout, chosen)
    optional = ["README.md", *(f"{graph}_data" for graph in graphs)]
    return chosen, [*(file for file in optional if file in sizes), *documents, *graphs]


def _precisions(graphs: tuple[str, str], sizes: Mapping[str, int]) -> list[Precision]:
    """The precisions in which a repository has both graphs."""
    return [precision for precision in SUFFIXES if set(graph_names(graphs, precision)) <= set(sizes)]
