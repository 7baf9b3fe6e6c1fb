"""Writes the files of a model package, completely or not at all."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from ..core.errors import ModelError
from . import model_packages


def write_files(
    folder: Path, manifest: Mapping[str, Any], networks: Mapping[str, Callable[[Path], None]], tokenizer: str | None
) -> model_packages.Package:
    """Writes a package and reads it back.

    manifest: all but ``format``, ``parts`` and ``files``.  networks: part -> what writes its network to a file.
    tokenizer: the content of tokenizer.json, if the package has words. Raises ModelError if the folder exists, or a
    written network cannot run.
    """
    if folder.exists():
        raise ModelError(f"{folder} already exists: choose another folder for the package.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
        made = Path(temporary) / "package"
        made.mkdir()
        parts = {part: f"{part}.onnx" for part in networks}
        for part, write in networks.items():
            write(made / parts[part])
        if tokenizer is not None:
            parts["tokenizer"] = "tokenizer.json"
            (made / parts["tokenizer"]).write_text(tokenizer, encoding="utf-8")
        files = [file for own in parts.values() for file in (own, f"{own}.data") if (made / file).is_file()]
        hashes = {file: model_packages.hash_file(made / file) for file in files}
        whole = {"format": model_packages.FORMAT, **manifest, "parts": parts, "files": hashes}
        (made / model_packages.MANIFESTS[0]).write_text(yaml.safe_dump(whole, sort_keys=False), encoding="utf-8")
        package = model_packages.read_package(made)
        for part in networks:
            package.session(part)
        os.replace(made, folder)
    return model_packages.read_package(folder)


def stated_licence(folder: Path) -> str:
    """The license that a model card states, if it exists."""
    card = folder / "README.md"
    found = re.search(r"^license:\s*(\S+)", card.read_text(encoding="utf-8"), re.M) if card.is_file() else None
    return found[1] if found else "not stated: see the source"
