"""Files that come with freeocc3d and that users select by name: configurations, ablations and classes.

They are in ``configs/`` of the repository. The folder ``preset_files`` next to this module is a link to it, so that a
wheel contains them too.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from ..core.errors import ConfigError
from .option_types import is_text
from .typed_options import nearest, shortened

FOLDER = Path(__file__).parent / "preset_files"
_ABLATIONS = "ablations"


def find_preset(given: str | Path, kind: Literal["configuration", "classes"] = "configuration") -> Path:
    """Finds the file for a path or a name: ``mono`` is ``configs/mono.yaml``. ``rgbd_no_loops`` and
    ``ablations/rgbd_no_loops`` are files in ``configs/ablations``. With kind "classes", ``nyu40_to_embodiedocc`` is in
    ``configs/classes``.

    An existing file takes precedence over a preset. A path with a suffix and an absolute path are no names; they are
    returned unchanged. Raises ConfigError for an unknown name.
    """
    path = Path(given)
    if not is_text(str(given)):
        raise ConfigError(f"'{shortened(str(given))}' is not the name of a file or preset.")
    if path.suffix or path.is_absolute() or os.path.isfile(path):
        return path
    folders = (FOLDER / "classes",) if kind == "classes" else (FOLDER, FOLDER / _ABLATIONS)
    for folder in folders:
        if os.path.isfile(found := folder / f"{path}.yaml"):
            return found
    known = list_presets(kind)
    raise ConfigError(
        f"There is no file or preset '{shortened(str(given))}'{nearest(str(given), known)}. Give the path of a file, "
        f"or one of the presets {', '.join(name for name in known if not name.startswith(_ABLATIONS))}."
    )


def list_presets(kind: Literal["configuration", "classes"] = "configuration") -> list[str]:
    """The names that ``find_preset`` accepts, ablations last."""
    if kind == "classes":
        return _names(FOLDER / "classes")
    return [*_names(FOLDER), *(f"{_ABLATIONS}/{name}" for name in _names(FOLDER / _ABLATIONS))]


def _names(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.yaml"))
