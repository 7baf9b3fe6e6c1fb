"""Lifts image features to the Gaussians that an image shows, and fuses them over keyframes.

Paper, Sec. "Open-vocabulary Semantic Association": per-pixel embeddings z_t(u) are lifted to 3D with the depth and
attached to the Gaussian anchored there. Here each Gaussian collects features from every keyframe that sees it
(``visibility``). Features that other keyframes contradict are left out (``feature_fusion``). A slow encoder may get
only the keyframes that show most (``keyframe_choice``).
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..capture.read_ahead import call_ahead
from ..core.errors import FrameError
from ..core.progress import Progress
from ..core.types import Frame, Gaussians
from ..settings.stages import LanguageOptions as Options
from .encoders.base import Encoder
from .feature_fusion import FeatureFusion
from .keyframe_choice import choose_keyframes, measure_detail
from .visibility import find_visible


def lift_features(
    gaussians: Gaussians,
    frames: Sequence[Frame],
    T_world_cam: NDArray[np.float64],
    encoder: Encoder,
    options: Options | None = None,
    progress: Progress | None = None,
) -> NDArray[np.float16]:
    """(N, D) unit features of the Gaussians from keyframes at their poses (K, 4, 4); zero where nothing is known.

    Keyframes are decoded and encoded on a second thread while the one before is fused. One that cannot be encoded is
    left out, with a warning: the others see most of what it shows.
    """
    options, progress = options or Options(), progress or Progress()
    fusion = FeatureFusion(len(gaussians), encoder.dimension, options.disagreement)
    chosen = choose_encoded_keyframes(gaussians, frames, T_world_cam, options, encoder.coverage)
    progress.stage("language", len(chosen))
    with contextlib.closing(call_ahead(lambda row: _encode(encoder, frames[row]), chosen, depth=1)) as encoded:
        for done, (row, (frame, features)) in enumerate(zip(chosen, encoded, strict=True), start=1):
            if isinstance(features, FrameError):
                progress.warn(str(features))
            else:
                fusion.add(find_visible(gaussians, frame, T_world_cam[row], options), features)
            progress.advance(done)
    return fusion.features()


def _encode(encoder: Encoder, frame: Frame) -> tuple[Frame, NDArray[np.float16] | FrameError]:
    """The frame with its features, or why it has none."""
    try:
        return frame, encode_finite(encoder, frame)
    except FrameError as error:
        return frame, error.with_traceback(None)


def encode_finite(encoder: Encoder, frame: Frame) -> NDArray[np.float16]:
    """The frame's features. Raises FrameError if they are not finite, as a network in half precision may overflow."""
    features = encoder.encode(frame)
    if not np.isfinite(features).all():
        raise FrameError(f"The encoder's features of frame {frame.index} are not finite: the frame is left out.")
    return features


def choose_encoded_keyframes(
    gaussians: Gaussians,
    frames: Sequence[Frame],
    T_world_cam: NDArray[np.float64],
    options: Options,
    coverage: float | None = None,
) -> list[int]:
    """Rows of the keyframes to encode, ascending: as many as ``options.keyframes`` states, or else as show the
    encoder's ``coverage``."""
    count = most = len(frames)
    if options.keyframes is not None:
        most = max(1, round(options.keyframes * count)) if options.keyframes <= 1 else int(options.keyframes)
        coverage = None
    if most >= count and coverage is None:
        return list(range(count))
    views, sharp = [], []
    for frame, T in zip(frames, T_world_cam, strict=True):
        views.append(find_visible(gaussians, frame, T, options))
        sharp.append(measure_detail(frame.color))
    return choose_keyframes(views, sharp, len(gaussians), most, coverage)
