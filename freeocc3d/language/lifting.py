"""Lifts image features onto the Gaussians that an image shows, and fuses them over keyframes.

Paper, Sec. "Open-vocabulary Semantic Association": per-pixel embeddings z_t(u) are lifted to 3D with the depth and
attached to the Gaussian anchored there. Here each Gaussian collects them from every keyframe that sees it
(``visibility``), those that the other keyframes contradict are left out (``fusion``), and an encoder that takes long is
given only the keyframes that say the most (``choice``).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

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
    """(N, D) unit features of the Gaussians from some keyframes at their poses (K, 4, 4); zero where nothing is known.

    A keyframe that cannot be encoded is left out, with a warning: the others see most of what it showed.
    """
    options, progress = options or Options(), progress or Progress()
    fusion = FeatureFusion(len(gaussians), encoder.dimension, options.disagreement)
    chosen = choose_encoded_keyframes(gaussians, frames, T_world_cam, options)
    progress.stage("language", len(chosen))
    for done, row in enumerate(chosen, start=1):
        frame = frames[row]
        try:
            features = _encoded(encoder, frame)
        except FrameError as error:
            progress.warn(str(error))
        else:
            fusion.add(find_visible(gaussians, frame, T_world_cam[row], options), features)
        progress.advance(done)
    return fusion.features()


def _encoded(encoder: Encoder, frame: Frame) -> NDArray[np.float16]:
    """The frame's features. Raises FrameError if they are not finite: a network in half precision may overflow."""
    features = encoder.encode(frame)
    if not np.isfinite(features).all():
        raise FrameError(f"The encoder gives numbers that are not finite for frame {frame.index}: it is left out.")
    return features


def choose_encoded_keyframes(
    gaussians: Gaussians, frames: Sequence[Frame], T_world_cam: NDArray[np.float64], options: Options
) -> list[int]:
    """Rows of the keyframes that are encoded, ascending: as many as ``options.keyframes`` allows."""
    count = len(frames)
    most = max(1, round(options.keyframes * count)) if options.keyframes <= 1 else int(options.keyframes)
    if most >= count:
        return list(range(count))
    views, sharp = [], []
    for frame, T in zip(frames, T_world_cam, strict=True):
        views.append(find_visible(gaussians, frame, T, options))
        sharp.append(measure_detail(frame.color))
    return choose_keyframes(views, sharp, len(gaussians), most)
