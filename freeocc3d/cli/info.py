"""``freeocc3d info``: what is in a map and how it was made."""

from __future__ import annotations

import json

from .console import Json, MapPath
from .map_summary import summary_document, summary_text


def info(map_path: MapPath, as_json: Json = False) -> None:
    """Show what is in a map and how it was made."""
    from ..query.scan_map import load_map

    loaded = load_map(map_path)
    print(json.dumps(summary_document(loaded)) if as_json else summary_text(loaded))
