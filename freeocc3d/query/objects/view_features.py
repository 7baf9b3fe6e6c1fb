"""Features of objects from pictures of them: the part of a keyframe that shows an object fills the encoder's image.

The mean over an object's best views says better what it is than the mean over its voxels. Source: Q. Gu et al.,
ConceptGraphs, ICRA 2024; A. Werby et al., HOV-SG, RSS 2024.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FreeOccError
from ...storage.saved_map import SavedMap
from ..best_views import RegionView

_MARGIN = 0.1  # of a box's edges, to each side: some surroundings help
_LEAST_PIXELS = 16  # shortest edge of a box that says something: a patch of common networks


def embed_views(scan_map: SavedMap, views: Sequence[Sequence[RegionView]], dimension: int) -> NDArray[np.float32]:
    """Returns the (N, D) unit mean embedding of each object's views; zero without a view that is large enough, or if
    the map's encoder is not installed or has no embedding of whole pictures.

    Raises MapError for a broken keyframe.
    """
    total = np.zeros((len(views), dimension), np.float32)
    if not scan_map.text_encoder.open_vocabulary or scan_map.encoder_needs_capture:
        return total
    try:
        encoder = scan_map.encoder
    except FreeOccError:  # a map may be read where its network is not: its voxels have features
        return total
    row_of = {frame: row for row, frame in enumerate(scan_map.keyframes.frames)}
    shown = sorted((view.frame, n, view.box) for n, own in enumerate(views) for view in own)
    frame, rgb = -1, np.zeros((0, 0, 3), np.uint8)
    for wanted, n, (x0, y0, x1, y1) in shown:
        if min(x1 - x0, y1 - y0) + 1 < _LEAST_PIXELS:
            continue
        if wanted != frame:
            frame, rgb = wanted, scan_map.keyframes[row_of[wanted]].color
        across, down = round(_MARGIN * (x1 - x0 + 1)), round(_MARGIN * (y1 - y0 + 1))
        part = rgb[max(y0 - down, 0) : y1 + down + 1, max(x0 - across, 0) : x1 + across + 1]
        embedded = encoder.embed(part)
        if embedded is None:
            break
        if np.isfinite(embedded).all():
            total[n] += embedded
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(total / np.where(length > 0, length, 1), np.float32)
