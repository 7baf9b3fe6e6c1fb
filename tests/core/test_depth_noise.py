"""The noise of depth: an image's own, or the sensor's usual noise; the same by pixel and by image."""

import numpy as np
import pytest
from scenes import wall_frame, with_sigma

from freeocc3d.core.depth_noise import AXIAL_NOISE, compute_sigma_image, look_up_sigma, take_stated_sigma
from freeocc3d.occupancy import carve


@pytest.mark.parametrize("stated", [False, True])
def test_a_pixel_has_the_standard_deviation_of_the_image(stated) -> None:
    frame = wall_frame(2.0, seed=3)
    frame = with_sigma(frame) if stated else frame
    image, own = compute_sigma_image(frame), take_stated_sigma(frame)
    for row, column in np.random.default_rng(0).integers(0, frame.depth_m.shape, (50, 2)):
        found = look_up_sigma(own, row, column, frame.depth_m[row, column])
        np.testing.assert_allclose(found, image[row, column], rtol=1e-6)


def test_carving_takes_the_growth_of_the_same_model() -> None:
    assert carve.Options().noise == AXIAL_NOISE[1]
