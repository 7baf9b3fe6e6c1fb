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


@pytest.mark.parametrize(
    ("shape", "size"),
    [((480, 640), (392, 518)), ((640, 480), (518, 392)), ((100, 1000), (56, 518)), ((4, 900), (14, 518))],
)
def test_an_input_of_free_size_is_518_pixels_long_in_whole_patches(tmp_path: Path, shape, size) -> None:
    color = np.zeros((*shape, 3), np.uint8)
    assert depth_network.load_depth_network(write_network(tmp_path / "a.onnx"))._size(color) == size
    tall = depth_network.load_depth_network(write_network(tmp_path / "b.onnx", (28, "width")))
    assert tall._size(color) == (28, size[1])
    assert depth_network.load_depth_network(write_network(tmp_path / "c.onnx", (28, 42)))._size(color) == (28, 42)


def test_stereo_and_a_guess_are_weighted_by_their_variances() -> None:
    """Stereo is off by the same much to either side of the guess."""
    rng = np.random.default_rng(0)
    truth = np.linspace(0.2, 0.8, 4000, dtype=np.float32).reshape(50, 80)
    off = np.where(np.arange(4000) % 2, 0.02, -0.02).reshape(50, 80)
    sigma = np.float32(rng.uniform(0.002, 0.03, truth.shape))
    inverse = np.float32(truth + off)
    inverse[:, 60:] = 0
    found, spread = depth_network.fuse_guess(inverse, sigma, np.float32(2.0 * truth + 0.5))
    theirs = 1 / ((1.4826 * 0.02) ** 2 + (0.02 * truth) ** 2)
    own = np.where(inverse > 0, 1 / sigma**2, 0)
    np.testing.assert_allclose(found, (own * inverse + theirs * truth) / (own + theirs), rtol=5e-3)
    np.testing.assert_allclose(spread, 1 / np.sqrt(own + theirs), rtol=0.02)


def test_a_guess_far_beyond_what_stereo_saw_is_left_out() -> None:
    inverse = np.linspace(0.3, 0.6, 4000, dtype=np.float32).reshape(50, 80)
    guess, sigma = inverse.copy(), np.full_like(inverse, 0.01)
    for column, value in ((0, 0.89), (1, 0.91), (2, 0.201), (3, 0.199)):
        inverse[:, column], guess[:, column] = 0, value
    inverse[0, 4], inverse[0, 5] = 0.3, 0.6
    guess[0, 4], guess[0, 5] = 0.3, 0.6
    found, spread = depth_network.fuse_guess(inverse, sigma, guess)
    for column, value, kept in ((0, 0.89, True), (1, 0.91, False), (2, 0.201, True), (3, 0.199, False)):
        np.testing.assert_allclose(found[:, column], value if kept else 0, rtol=1e-3)
        assert (spread[:, column] > 0).all() == kept


@pytest.mark.parametrize(("count", "used"), [(199, False), (200, True)])
def test_a_fit_needs_two_hundred_pixels(count: int, used: bool) -> None:
    truth = np.linspace(0.2, 0.8, 3000, dtype=np.float32).reshape(50, 60)
    inverse = truth.copy()
    inverse.flat[np.random.default_rng(0).permutation(3000)[count:]] = 0
    found, _ = depth_network.fuse_guess(inverse, np.full_like(truth, 0.01), truth)
    assert np.count_nonzero(found) == (3000 if used else count)
