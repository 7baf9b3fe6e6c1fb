"""Depth that ends at no surface carves nothing: the kernel against a plain set of cells, and specks behind a pane."""

import numpy as np
from scenes import CAMERA, lifted, posed, wall_frame, with_sigma

from freeocc3d.core.transforms import back_project, transform
from freeocc3d.core.types import FREE
from freeocc3d.occupancy import build, carve, splat
from freeocc3d.occupancy.confirmed_depth import hide_unconfirmed


def test_a_pixel_is_confirmed_by_gaussians_around_its_end() -> None:
    """Random depth before half a wall. What is kept without a look-up of its own is near what a look-up found."""
    T = np.eye(4)
    T[:3, 3] = 0.3, -0.2, 0.1
    g = lifted([wall_frame(2.0)], T[None], 0.05)
    g, edge = g[g.means[:, 0] > 0.3], 0.05
    frame = with_sigma(wall_frame(2.0))
    frame.depth_m[:] = np.random.default_rng(0).uniform(1.5, 2.5, frame.depth_m.shape)
    frame.depth_sigma_m[:] = 0.04  # three of them are three cells, to be looked at in both directions
    kept = next(hide_unconfirmed(posed([frame], T[None]), g, 2 * edge)).frame.depth_m == frame.depth_m

    def cells(points: np.ndarray) -> np.ndarray:
        return np.floor(points / edge).astype(int)

    around = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 3)
    marked = {tuple(cell) for step in around for cell in cells(g.means) + step}
    v, u = np.indices(frame.depth_m.shape)
    expected = np.zeros(kept.shape, bool)
    for off in np.arange(-3, 4) * 0.04:
        ends = transform(T, back_project(np.stack((u, v), axis=-1).reshape(-1, 2), frame.depth_m.ravel() + off, CAMERA))
        expected |= np.array([tuple(cell) in marked for cell in cells(ends)]).reshape(kept.shape)
    assert 0.1 < expected.mean() < 0.4
    assert kept[expected].mean() > 0.999  # ends on faces of cells, in single precision
    assert (kept & ~expected).mean() < 0.15
    assert not kept[:, : CAMERA.width // 3].any()


def test_what_lies_behind_a_pane_with_specks_is_unknown() -> None:
    rng = np.random.default_rng(0)
    frames = [wall_frame(2.0, n) for n in range(40)]
    for frame in frames:
        frame.depth_m[:, :30] = 0
        speck = rng.integers((0, 0), (CAMERA.height - 4, 26))
        frame.depth_m[speck[0] : speck[0] + 4, speck[1] : speck[1] + 4] = rng.uniform(2.5, 5.0)
    looks = posed(frames, np.tile(np.eye(4), (40, 1, 1)))
    g = lifted(frames, np.tile(np.eye(4), (40, 1, 1)), 0.04)
    states = []
    for seen in (looks, hide_unconfirmed(looks, g, 0.08)):
        made = build.build_occupancy(g, np.zeros((len(g), 0), np.float16), seen, splat.Options(), carve.Options())
        free = (made.voxels(FREE) + 0.5) * made.voxel_size
        states.append((free[:, 2] > 2.1).sum())
        assert (free[:, 2] < 1.9).sum() > 1000
    assert states[0] > 200
    assert states[1] < 0.05 * states[0]
