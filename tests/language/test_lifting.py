"""Layer 3 as a whole: keyframes in, features of the Gaussians out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA, gaussians

from freeocc3d.core.errors import CaptureError, ConfigError, FrameError
from freeocc3d.core.progress import Progress
from freeocc3d.core.types import Frame
from freeocc3d.language.encoders.base import Encoder
from freeocc3d.language.lifting import Options, choose_encoded_keyframes, lift_features

WALL = gaussians([(x, y, 2.0) for x in np.linspace(-1, 1, 20) for y in np.linspace(-0.8, 0.8, 20)], 0.02)


class Halves(Encoder):
    """The left half of every image is one thing, the right half another; frame 7 cannot be encoded, and 9 overflows."""

    name, dimension = "halves", 2

    def __init__(self) -> None:
        self.asked: list[int] = []

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        self.asked.append(frame.index)
        if frame.index == 7:
            raise FrameError("Frame 7 is broken.")
        if frame.index == 8:
            raise CaptureError("The class images are not there.")
        return np.eye(2, dtype=np.float16)[None] * np.float16(np.inf if frame.index == 9 else 1)

    def text_state(self) -> dict[str, Any]:
        return {}


class Warnings(Progress):
    def __init__(self) -> None:
        self.said: list[str] = []

    def warn(self, text: str) -> None:
        self.said.append(text)


def frames(*indices: int) -> list[Frame]:
    """Views of the wall; odd ones are without texture, as if out of focus."""

    def images() -> Iterator[Frame]:
        for index in indices:
            noise = np.random.default_rng(index).integers(0, 255, (CAMERA.height, CAMERA.width, 3)).astype(np.uint8)
            color = np.full_like(noise, 100) if index % 2 else noise
            yield Frame(index, float(index), color, np.full(noise.shape[:2], 2.0, np.float32), CAMERA)

    return list(images())


def poses(count: int) -> NDArray[np.float64]:
    return np.tile(np.eye(4), (count, 1, 1))


def test_features_come_from_where_the_gaussians_project_to() -> None:
    features = lift_features(WALL, frames(0, 2, 4), poses(3), Halves())
    seen = features.any(axis=1)
    left = WALL.means[:, 0] < 0
    assert seen.mean() > 0.5
    np.testing.assert_allclose(features[seen & left], np.broadcast_to((1, 0), (np.sum(seen & left), 2)), atol=1e-3)
    np.testing.assert_allclose(features[seen & ~left], np.broadcast_to((0, 1), (np.sum(seen & ~left), 2)), atol=1e-3)


def test_a_broken_frame_is_left_out_with_a_warning_and_others_faults_are_reported() -> None:
    told = Warnings()
    assert lift_features(WALL, frames(7, 2), poses(2), Halves(), None, told).any()
    assert told.said == ["Frame 7 is broken."]
    assert np.isfinite(lift_features(WALL, frames(9, 2), poses(2), Halves(), None, told)).all()
    assert "features of frame 9 are not finite" in told.said[1]
    with pytest.raises(CaptureError):
        lift_features(WALL, frames(8), poses(1), Halves())


@pytest.mark.parametrize(("keyframes", "count"), [(0.5, 3), (2.0, 2), (0.01, 1), (1.0, 6), (100.0, 6)])
def test_the_budget_is_a_share_or_a_number(keyframes: float, count: int) -> None:
    views = frames(0, 1, 2, 3, 4, 5)
    encoder = Halves()
    options = Options(keyframes=keyframes)
    lift_features(WALL, views, poses(6), encoder, options)
    assert len(encoder.asked) == count
    assert encoder.asked == choose_encoded_keyframes(WALL, views, poses(6), options)
    if count <= 3:
        assert not any(index % 2 for index in encoder.asked)  # the sharp ones


def test_an_encoder_with_a_network_gets_as_many_as_show_nearly_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Halves, "coverage", 0.98)
    T = poses(6)
    T[:4, 0, 3], T[4:, 0, 3] = -1.5, 1.5
    encoder = Halves()
    lift_features(WALL, frames(0, 1, 2, 3, 4, 5), T, encoder)
    assert 1 < len(encoder.asked) < 4
    assert any(index >= 4 for index in encoder.asked)
    assert any(index < 4 for index in encoder.asked)


@pytest.mark.parametrize(
    "bad",
    [{"visible_within": 0.0}, {"near": 0.0}, {"visible_share": -0.1}, {"keyframes": 0.0}, {"border": 0.6},
     {"disagreement": 0.0}],
)  # fmt: skip
def test_options_out_of_range_are_refused(bad: dict) -> None:
    with pytest.raises(ConfigError):
        Options(**bad)
