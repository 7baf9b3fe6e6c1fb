"""Divides the surface of a map into things by masks in its keyframes, whose numbers mean nothing from view to view.

Each keyframe votes on each pair of neighbors on the surface of which it shows both in masks: for one thing if they are
in one mask, against it if they are in two. So no mask needs to be found again in another view, and a view that splits a
thing, or takes two for one, is outvoted by the others. The shape of the surface has half a vote: it decides where no
keyframe tells. Average linkage then makes things of the pairs, so that no single pair decides.

Sources: agreement of views over masks: M. Yan et al., MaskClustering, CVPR 2024; affinities of parts of the surface
from masks in all views that show them: Y. Yin et al., SAI3D, CVPR 2024.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...settings.stages import LanguageOptions
from ...storage.saved_map import SavedMap
from .object import Segment

_SHAPE = 0.5
"""Votes of the shape of the surface."""


def count_votes(
    scan_map: SavedMap, pairs: NDArray[np.int64], segment: Segment, most: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Returns the (E,) numbers of keyframes that have each pair of Gaussians in one mask, and in two.

    pairs: (E, 2) rows of Gaussians.  most: keyframes to ask; those that show most are chosen. Raises MapError for a
    broken keyframe.
    """
    from ...language.lifting import choose_encoded_keyframes
    from ...language.visibility import find_visible

    gaussians, poses = scan_map.gaussians, scan_map.trajectory.T_world_keyframe
    options = LanguageOptions(keyframes=float(max(most, 2)))
    together, apart = np.zeros(len(pairs), np.int32), np.zeros(len(pairs), np.int32)
    for row in choose_encoded_keyframes(gaussians, scan_map.keyframes, poses, options):
        frame = scan_map.keyframes[row]
        seen = find_visible(gaussians, frame, poses[row], options)
        mask = np.zeros(len(gaussians), np.int32)
        mask[seen.rows] = segment(frame).ravel()[seen.pixels]
        a, b = mask[pairs].T
        known = (a > 0) & (b > 0)
        together += known & (a == b)
        apart += known & (a != b)
    return together, apart


def weigh_votes(
    together: NDArray[np.int32], apart: NDArray[np.int32], shape: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the (E,) weights of pairs, -1…1, positive for one thing. shape: (E,) what the shape of the surface says,
    -1…1."""
    return np.asarray((together - apart + _SHAPE * shape) / (together + apart + _SHAPE))
