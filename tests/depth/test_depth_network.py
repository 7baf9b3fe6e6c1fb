"""A tiny network in the place of a monocular depth network."""

from pathlib import Path

import numpy as np
import pytest
from depth_networks import write_network

from freeocc3d.core.errors import ModelError
from freeocc3d.depth import depth_network

RAMP = np.broadcast_to(np.linspace(50, 250, 64, dtype=np.uint8)[None, :, None], (48, 64, 3)).copy()


@pytest.mark.parametrize("size", [("height", "width"), (56, 70)])
def test_output_has_the_size_that_stereo_has(tmp_path: Path, size) -> None:
    network = depth_network.load_depth_network(write_network(tmp_path / "n.onnx", size))
    guess = network(RAMP, 32, 24)
    assert guess.shape == (24, 32)
    np.testing.assert_allclose(guess[12, 2:-2], np.linspace(50, 250, 32)[2:-2] / 255, atol=0.02)


def test_depth_becomes_inverse_depth(tmp_path: Path) -> None:
    inverse = depth_network.load_depth_network(write_network(tmp_path / "a.onnx"))(RAMP, 32, 24)
    depth = depth_network.load_depth_network(write_network(tmp_path / "b.onnx", output="depth"))(RAMP, 32, 24)
    np.testing.assert_allclose(depth[:, 2:-2], 1 / inverse[:, 2:-2], rtol=0.03)


@pytest.mark.parametrize(("given", "says"), [({"channels": 1}, "must take one image"), ({"output": "x"}, "'output'")])
def test_other_networks_are_refused(tmp_path: Path, given, says: str) -> None:
    with pytest.raises(ModelError, match=says):
        depth_network.load_depth_network(write_network(tmp_path / "n.onnx", **given))


def test_a_guess_is_fitted_and_fills_what_is_empty() -> None:
    rng = np.random.default_rng(0)
    truth = np.linspace(0.2, 0.8, 48 * 64, dtype=np.float32).reshape(48, 64)
    guess = (3.0 * truth - 0.3 + 0.02 * rng.normal(size=truth.shape)).astype(np.float32)
    inverse, sigma = truth.copy(), np.full_like(truth, 0.002)
    inverse[:, 32:] = 0.0
    inverse[::7, ::5] *= 1.5  # what stereo got wrong does not draw the fit
    found, spread = depth_network.fuse_guess(inverse, sigma, guess)
    empty = np.s_[:, 32:]
    off = np.abs(found - truth)[empty]
    assert np.median(off / truth[empty]) < 0.03
    assert 0.2 < np.median(off / spread[empty]) < 1.2
    kept = np.s_[1::7, 1:32:5]
    np.testing.assert_allclose(found[kept], truth[kept], rtol=0.02)
    assert (spread[kept] <= sigma[kept] + 1e-7).all()


def test_without_stereo_or_against_it_a_guess_is_not_used() -> None:
    truth = np.linspace(0.2, 0.8, 3072, dtype=np.float32).reshape(48, 64)
    sigma = np.full_like(truth, 0.002)
    none = np.zeros_like(truth)
    np.testing.assert_array_equal(depth_network.fuse_guess(none, sigma, truth)[0], none)
    np.testing.assert_array_equal(depth_network.fuse_guess(truth, sigma, -truth)[0], truth)
