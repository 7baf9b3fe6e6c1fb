"""Half floats in compiled code."""

import numpy as np

from freeocc3d.core.half_floats import widen_halves


def test_every_finite_half_float_widens_to_the_same_number() -> None:
    every = np.arange(1 << 16).astype(np.uint16)
    halves = every[np.isfinite(every.view(np.float16))]
    wide = np.empty(len(halves), np.float32)
    widen_halves(halves, wide.view(np.int32), wide)
    expected = halves.view(np.float16).astype(np.float32)
    np.testing.assert_array_equal(wide.view(np.int32), expected.view(np.int32))  # bits: -0 is not 0
