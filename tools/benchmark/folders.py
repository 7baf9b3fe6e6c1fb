"""Where captures and networks are."""

from __future__ import annotations

import os
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FREEOCC3D_DATA") or REPOSITORY.parent / "shared" / "data")
MODELS = DATA.parent / "models"


def capture_name(capture: Path) -> str:
    """The capture's name in tables: its path in the data folder, or its folder's name."""
    capture, data = capture.resolve(), DATA.resolve()
    return str(capture.relative_to(data)) if capture.is_relative_to(data) else capture.name
