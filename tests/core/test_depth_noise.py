"""The noise of depth: an image's own, or that of its sensor; the same by pixel and by image."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import wall_frame, with_sigma

from freeocc3d.core.depth_noise import compute_sigma_image, look_up_sigma, take_sigma
from freeocc3d.core.depth_sensors import AUTO, SENSORS, STEREO, STRUCTURED_LIGHT, TIME_OF_FLIGHT, find_sensor
from freeocc3d.core.errors import ConfigError
from freeocc3d.settings import config


@pytest.mark.parametrize("stated", [None, *SENSORS])
def test_a_pixel_has_the_standard_deviation_of_the_image(stated) -> None:
    frame = wall_frame(2.0, seed=3)
    frame = with_sigma(frame) if stated is None else replace(frame, sensor=SENSORS[stated])
    image, own = compute_sigma_image(frame), take_sigma(frame)
    for row, column in np.random.default_rng(0).integers(0, frame.depth_m.shape, (50, 2)):
        found = look_up_sigma(own, row, column, frame.depth_m[row, column])
        np.testing.assert_allclose(found, image[row, column], rtol=1e-6)


def test_sensors_have_the_noise_of_their_sources() -> None:
    z = np.array([1.0, 2.0, 4.0])
    kinect_v2 = 1e-3 * (1.5 - 0.5 * z + 0.3 * z**2)
    np.testing.assert_allclose(TIME_OF_FLIGHT.compute_sigma(z), kinect_v2, rtol=0.01)
    subpixel, focal, baseline = 0.08, 425, 0.05
    np.testing.assert_allclose(STEREO.compute_sigma(z) - 5e-4, subpixel * z**2 / (focal * baseline), rtol=0.02)
    assert find_sensor(AUTO) is STRUCTURED_LIGHT
    assert find_sensor("stereo") is STEREO


def test_every_sensor_can_be_chosen() -> None:
    for name in (AUTO, *SENSORS):
        assert config.resolve({"capture": {"sensor": name}}).capture.sensor == name
    with pytest.raises(ConfigError, match=r"'capture\.sensor' must be"):
        config.resolve({"capture": {"sensor": "sonar"}})
