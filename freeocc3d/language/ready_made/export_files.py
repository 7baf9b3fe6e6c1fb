"""Reads the files of ready-made exports, which may come from anybody."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec
import onnx
from msgspec import Meta

from ...core.errors import ModelError
from ...core.onnx_files import find_external_files
from ...core.regular_files import read_text
from ...core.typed_documents import InvalidDocument, as_type, parse_json
from .. import model_packages
from .onnx_graphs import sign_weights

_LARGEST_CONFIG = 1 << 20

Side = Annotated[int, Meta(ge=16, le=4096)]
"""Pixels of a side of an image."""


class Size(msgspec.Struct):
    """The size of a network's images, as preprocessor_config.json states it."""

    height: Side | None = None
    shortest_edge: Side | None = None


def read_document(path: Path, kind: Any) -> Any:
    """A JSON file as a typed document. Raises ModelError."""
    try:
        return as_type(parse_json(read_text(path, _LARGEST_CONFIG)), kind)
    except OSError as error:
        raise ModelError(f"Cannot read {path}: {error.strerror}.") from error
    except (ValueError, InvalidDocument) as error:
        raise ModelError(
            f"{path} is not the configuration of a model that can be used: {' '.join(str(error).split())}."
        ) from error


def load_graph(folder: Path, name: str, source: str) -> onnx.ModelProto:
    """A graph of the export, with weights that it keeps beside it. Raises ModelError."""
    path = folder / name
    try:
        for outside in find_external_files(path):
            if not model_packages.is_plain_name(outside) or not (path.parent / outside).is_file():
                raise ModelError(
                    f"{name} of {source} keeps weights in '{outside[:80]}', which is no file beside it: it is refused."
                )
        model = onnx.load(path)
        sign_weights(model)
        return model
    except OSError as error:
        raise ModelError(f"Cannot read {path}: {error.strerror}.") from error
    except ModelError:
        raise
    except Exception as error:  # protobuf's errors share no base class
        raise ModelError(f"{name} of {source} is not an ONNX network that can be read.") from error


def save_graph(model: onnx.ModelProto, path: Path) -> None:
    """Writes a graph to a file."""
    onnx.save(model, path)
