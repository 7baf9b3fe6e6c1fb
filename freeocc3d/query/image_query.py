"""Asks by picture: finds where the map looks like a part of an image. The module imports little, to start fast."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError
from ..core.image_files import ImageFileError, read_image
from ..core.types import Frame, Intrinsics, Occupancy
from ..language.feature_codec import Features, compute_cosines, mask_known
from ..storage.saved_map import SavedMap
from .word_query import Options, QueryResult, find_regions

if TYPE_CHECKING:
    from ..language.encoders.base import Encoder

_ALIKE = 0.5
"""Least cosine of a match, with the map's mean subtracted from both features."""

Box = tuple[int, int, int, int]


def picture_encoder(scan_map: SavedMap) -> Encoder:
    """Returns the map's encoder, to encode a picture.

    Raises FreeOccError if the encoder needs more than a picture, or cannot be loaded again.
    """
    if scan_map.encoder_needs_capture:
        raise FreeOccError(
            f"The map's encoder '{scan_map.manifest.encoder.name}' reads more of the capture than its pictures, so it "
            "cannot encode a single picture: ask for words instead."
        )
    return scan_map.encoder


def patch_feature(
    encoder: Encoder, image: str | Path | NDArray[np.uint8], box: Box | None = None
) -> NDArray[np.float32]:
    """Returns the (D,) unit mean of an encoder's features over a part of an image, weighted by the encoder's certainty.

    image: a file, or (H, W, 3) uint8 RGB.  box: x0, y0, x1, y1, pixels, with the last ones included; the whole image by
    default. The encoder sees the whole image. Raises FreeOccError: not an image, a box outside of it, no features.
    """
    rgb = image if isinstance(image, np.ndarray) else _read(Path(image))
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or not rgb.size:
        raise FreeOccError(f"A picture is (H, W, 3) uint8 RGB, got {rgb.dtype} {rgb.shape}.")
    height, width = rgb.shape[:2]
    x0, y0, x1, y1 = box or (0, 0, width - 1, height - 1)
    if not (0 <= x0 <= x1 < width and 0 <= y0 <= y1 < height):
        raise FreeOccError(
            f"The box {x0} {y0} {x1} {y1} does not lie in the picture. Its pixels go from 0 0 to {width - 1} "
            f"{height - 1}: give x0 y0 x1 y1 with x0 <= x1 and y0 <= y1."
        )
    camera = Intrinsics(width, height, float(width), float(width), (width - 1) / 2, (height - 1) / 2)
    features = encoder.encode(Frame(0, 0.0, rgb, np.zeros((height, width), np.float32), camera)).astype(np.float32)
    rows, columns = features.shape[:2]
    inside = features[y0 * rows // height : y1 * rows // height + 1, x0 * columns // width : x1 * columns // width + 1]
    mean = inside.reshape(-1, features.shape[2]).sum(axis=0)
    length = float(np.linalg.norm(mean))
    if not np.isfinite(length) or length == 0:
        raise FreeOccError("The map's encoder finds no feature in this part of the picture: choose another part.")
    return np.asarray(mean / length, np.float32)


def query_feature(
    occupancy: Occupancy,
    feature: NDArray[np.float32],
    name: str,
    options: Options | None = None,
    up: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 1.0),
) -> QueryResult:
    """Finds where the map's features are like a given feature, (D,) of unit length.

    A voxel's score is the cosine after the map's mean feature m is subtracted from both features: (f - m)^T (q - m)
    over the lengths. The reason is that features of images are much alike, whatever the images show. There are no
    contrast words: a region's confidence is the mean score of its voxels. Raises FreeOccError if the feature's length
    is that of another encoder.
    """
    options = options or Options()
    if options.scores != "cosine":
        raise FreeOccError("A picture is compared by cosines: use --scores with words only.")
    features = occupancy.features
    if len(features) and features.shape[1] != len(feature):
        raise FreeOccError(
            f"The map's features have {features.shape[1]} dimensions, those of pictures {len(feature)}: reconstruct "
            "the map with this version."
        )
    scores = _apart_from_mean(features, feature)
    threshold = _ALIKE if options.threshold is None else options.threshold
    rows = np.flatnonzero(scores >= min(options.grow * threshold, threshold)) if len(scores) else np.zeros(0, np.int64)
    regions = find_regions(occupancy, rows, scores[rows], scores[rows], threshold, options, up, name)
    note = ""
    if not len(scores):
        note = "The map has no occupied voxels."
    elif not regions:
        note = f"Nothing in this map looks like {name}: the best score is {scores.max():.2f}, below {threshold:.2f}."
    return QueryResult(name, name, note, regions, scores)


def _apart_from_mean(features: Features, feature: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns the (V,) cosines of unit features and one feature, with the mean subtracted; 0 where nothing is known."""
    says = mask_known(features)
    if not says.any():
        return np.zeros(len(features), np.float32)
    mean = _mean(features, says)
    products = compute_cosines(features, np.stack((feature, mean)))
    squared = float(mean @ mean)
    length = np.sqrt(np.maximum(1 - 2 * products[:, 1] + squared, 1e-12))
    own = float(np.sqrt(max(1 - 2 * float(feature @ mean) + squared, 1e-12)))
    score = (products[:, 0] - products[:, 1] - float(feature @ mean) + squared) / (length * own)
    return np.where(says, np.clip(score, -1, 1), 0).astype(np.float32)


def _mean(features: Features, says: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Returns the (D,) mean of the known features."""
    total, at_once = np.zeros(features.shape[1]), 1 << 14
    for start in range(0, len(features), at_once):
        total += np.asarray(features[start : start + at_once]).astype(np.float32).sum(axis=0)
    return np.asarray(total / np.count_nonzero(says), np.float32)


def _read(path: Path) -> NDArray[np.uint8]:
    import cv2

    try:
        image = read_image(path, cv2.IMREAD_COLOR)
    except ImageFileError as error:
        raise FreeOccError(f"{error} Give a picture as a PNG or JPEG file.") from error
    return np.asarray(image[..., ::-1])
