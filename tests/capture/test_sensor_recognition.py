"""The sensor that took a scan's depth is recognized by the steps and the noise of the depth."""

import numpy as np
import pytest

from freeocc3d.capture.checks.sensor_recognition import recognize_sensor
from freeocc3d.core.depth_sensors import STRUCTURED_LIGHT, TIME_OF_FLIGHT

FOCAL_BASELINE = {8: 580 * 0.075, 32: 383 * 0.05}
"""Focal length in pixels times baseline in meters: Kinect v1 has eighths of a pixel, RealSense D435 32nd parts."""


class Stored:
    """A capture of millimeters that a sensor looking at slanted walls stores."""

    def __init__(self, parts: int | None, sigma, units: float = 1000.0):
        self.parts, self.sigma, self.units = parts, sigma, units

    def __len__(self) -> int:
        return 3

    def raw_depth(self, index: int):
        rng = np.random.default_rng(index)
        depth = np.tile(np.linspace(0.6 + 0.2 * index, 5.5, 320), (240, 1))
        depth += self.sigma(depth) * rng.standard_normal(depth.shape)
        if self.parts:
            disparity = FOCAL_BASELINE[self.parts] / depth
            depth = FOCAL_BASELINE[self.parts] / (np.rint(disparity * self.parts) / self.parts)
        return np.rint(depth * self.units).astype(np.uint16), self.units


def projected(depth_m):
    return STRUCTURED_LIGHT.compute_sigma(depth_m)


@pytest.mark.parametrize("units", [1000.0, 5000.0])
@pytest.mark.parametrize(
    ("parts", "sigma", "name"),
    [
        (8, projected, "structured_light"),
        (8, lambda depth_m: 0.2 * projected(depth_m), "structured_light"),  # smoothed
        (32, projected, "stereo"),
        (None, projected, "structured_light"),
        (None, lambda depth_m: TIME_OF_FLIGHT.compute_sigma(depth_m), "time_of_flight"),
    ],
)
def test_a_sensor_is_told_by_its_steps_and_its_noise(parts, sigma, name: str, units: float) -> None:
    assert recognize_sensor(Stored(parts, sigma, units)).name == name


def test_depth_that_tells_nothing_counts_as_structured_light() -> None:
    empty = Stored(None, projected)
    empty.raw_depth = lambda index: (np.zeros((4, 4), np.uint16), 1000.0)
    assert recognize_sensor(empty) is STRUCTURED_LIGHT
