"""``freeocc3d info``: what is in a map and how it was made."""

from __future__ import annotations

from .console import Json, MapPath, show, show_document
from .map_summary import summary_document, summary_lines


def info(map_path: MapPath, as_json: Json = False) -> None:
    """Show what is in a map and how it was made."""
    from ..query.scan_map import load_map

    loaded = load_map(map_path)
    if as_json:
        show_document(summary_document(loaded))
    else:
        show(*summary_lines(loaded))
