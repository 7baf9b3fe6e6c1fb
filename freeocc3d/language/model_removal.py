"""Removes models from the models folder, and nothing else from anywhere."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import ModelError
from ..settings.registry import nearest
from .model_hub import CHECKPOINTS
from .model_packages import MANIFESTS, find_models_folder

_PARTIAL = ".partial"


@dataclass(frozen=True)
class Removable:
    """What has a model's name: its package, its checkpoint, and what was fetched of either. bytes: of all files."""

    name: str
    folders: tuple[Path, ...]
    bytes: int


def find_removable(name: str) -> Removable:
    """What there is of a model. Raises ModelError: none has this name, or its folder is no model's."""
    root = find_models_folder()
    places = root, root / CHECKPOINTS
    if Path(name).name != name or name.startswith("."):
        raise ModelError(f"'{name}' is not the name of a model in {root}: see 'freeocc3d models list'.")
    folders = [place / own for place in places for own in (name, name + _PARTIAL) if _exists(place / own)]
    if not folders:
        known = {path.name.removesuffix(_PARTIAL) for place in places if place.is_dir() for path in place.iterdir()}
        close = nearest(name, sorted(own for own in known if not own.startswith(".")))
        raise ModelError(f"There is no model '{name}' in {root}{close}.")
    for folder in folders:
        fetched = folder.parent != root or folder.suffix == _PARTIAL
        if not (fetched or folder.is_symlink() or any((folder / file).is_file() for file in MANIFESTS)):
            raise ModelError(f"{folder} is not a model: it has no {MANIFESTS[0]}. If nothing needs it, delete it.")
    return Removable(name, tuple(folders), sum(map(_size, folders)))


def remove(found: Removable) -> None:
    """Removes the folders; of a link to a folder elsewhere, the link. Raises ModelError."""
    for folder in found.folders:
        try:
            folder.unlink() if folder.is_symlink() else shutil.rmtree(folder)
        except OSError as error:
            raise ModelError(f"{folder} cannot be removed completely: {error.strerror}.") from error


def _exists(folder: Path) -> bool:
    return folder.is_symlink() or folder.is_dir()


def _size(folder: Path) -> int:
    """Bytes that removing frees: none of what links lead to."""
    if folder.is_symlink():
        return 0
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
