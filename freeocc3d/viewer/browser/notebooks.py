"""Shows a map in a cell of a notebook."""

from __future__ import annotations

import html

from ...core.errors import FreeOccError
from ...query.scan_map import Map
from ..map_colorings import color_map
from ..map_pictures import draw_coloring
from ..self_contained_pages import embed_image
from .single_file import make_whole_page

MOST_BYTES = 20_000_000
"""Largest page that a cell holds; of a larger map it holds a picture."""


def show_in_cell(scan_map: Map) -> str:
    """Returns HTML: the viewer with the whole map, in a frame; a picture of a map whose page is larger than
    ``MOST_BYTES``; or why it cannot be shown. Never raises FreeOccError, which would hide what the cell computed."""
    try:
        page = make_whole_page(scan_map)
        if len(page) <= MOST_BYTES:
            frame = 'width="100%" height="600" style="border: 0" title="The map"'
            return f'<iframe {frame} srcdoc="{html.escape(page)}"></iframe>'
        return f'<img alt="The map" src="{embed_image("png", draw_coloring(scan_map, color_map(scan_map)))}">'
    except FreeOccError as error:
        return f"<p>{html.escape(f'{scan_map.path}: {error}')}</p>"
