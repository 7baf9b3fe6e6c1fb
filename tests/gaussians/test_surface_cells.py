"""Sums by cells: compiled against plain NumPy, and independent of the order of the input."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, wall_frame, with_sigma

from freeocc3d.core.types import PosedFrame
from freeocc3d.gaussians.surface_cells import Cells, CellSums, cells_reference


def looks(count: int) -> list[PosedFrame]:
    """A noisy wall with holes, from cameras apart; the nearer ones measure better."""
    found = []
    for n in range(count):
        frame = wall_frame(2.0 + 0.2 * n, n, seed=n)
        frame.depth_m[np.random.default_rng(n).uniform(size=frame.depth_m.shape) < 0.3] = 0
        T = np.eye(4)
        T[:3, 3] = 0.1 * n, 0, -0.2 * n
        found.append(PosedFrame(frame, T, n))
    return found


def summed(frames: list[PosedFrame], cell: float = 0.05, step: int = 2) -> Cells:
    sums = CellSums(cell)
    for posed in frames:
        sums.add_frame(posed, step, 0.2)
    return sums.cells()


@pytest.mark.parametrize("own_sigma", [False, True])
def test_the_kernel_agrees_with_plain_numpy(own_sigma: bool) -> None:
    (posed,) = looks(1)
    posed = posed._replace(frame=with_sigma(posed.frame)) if own_sigma else posed
    for step, edge in ((1, 0.02), (3, 0.2)):
        sums = CellSums(0.05)
        sums.add_frame(posed, step, edge)
        found, expected = sums.cells(), cells_reference(posed, step, edge, 0.05)
        assert len(found) > 300
        np.testing.assert_array_equal(found.key, expected.key)
        np.testing.assert_array_equal(found.pixels, expected.pixels)
        for name in ("points", "colors", "weights", "best", "footprint"):
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=2e-5, atol=1e-6)


def test_frames_add_up_in_any_order() -> None:
    frames = looks(5)
    forth, back = summed(frames), summed(frames[::-1])
    for name in Cells.__dataclass_fields__:
        np.testing.assert_allclose(getattr(forth, name), getattr(back, name), rtol=1e-9)
    assert set(forth.keyframe.tolist()) == set(range(5))


def test_the_nearest_measurement_says_which_keyframe() -> None:
    near, far = looks(3)[0], looks(3)[2]
    both = summed([far, near])
    seen_near = np.isin(both.key, summed([near]).key)
    assert (both.keyframe[seen_near] == 0).mean() > 0.95  # noise puts some pixels of the far one nearer
    assert (both.keyframe[~seen_near] == 2).all()


def test_a_surer_measurement_outweighs_a_nearer_one() -> None:
    near, far = looks(2)
    sure = replace(far.frame, depth_sigma_m=np.full_like(far.frame.depth_m, 1e-4))
    both = summed([near, far._replace(frame=sure)])
    seen_far = np.isin(both.key, summed([far]).key)
    assert (both.keyframe[seen_far] == 1).all()
    assert (both.keyframe[~seen_far] == 0).all()


def test_cells_begin_at_an_origin() -> None:
    """Frames that move with the origin give the same cells."""
    origin, sums, frames = np.array((0.013, -2.02, 0.5)), CellSums(0.05), looks(2)
    moved = CellSums(0.05, origin)
    for posed in frames:
        sums.add_frame(posed, 2, 0.2)
        T = posed.T_world_cam.copy()
        T[:3, 3] += origin
        moved.add_frame(posed._replace(T_world_cam=T), 2, 0.2)
    plain, found = sums.cells(), moved.cells()
    assert (found.key == plain.key).mean() > 0.99  # rounding moves a pixel over an edge here and there
    again = CellSums(0.05, origin)
    again.add(found)
    np.testing.assert_array_equal(again.cells().key, found.key)
    np.testing.assert_allclose(again.cells().points, found.points, atol=1e-9)
    near = np.abs(found.points[: len(plain)] - origin - plain.points[: len(found)]).max(axis=1)
    assert np.median(near) < 1e-9


def test_means_that_are_added_again_stay_what_they_are() -> None:
    cells = summed(looks(4))
    sums = CellSums(0.05)
    sums.add(cells[::2])
    sums.add(cells[1::2])
    again = sums.cells()
    for name in Cells.__dataclass_fields__:
        np.testing.assert_allclose(getattr(again, name), getattr(cells, name), rtol=1e-9)


def test_a_table_grows_with_what_it_holds() -> None:
    sums = CellSums(0.002)
    for posed in looks(6):
        sums.add_frame(posed, 1, 0.2)
    assert len(sums.cells()) > 0.5 * 6 * 0.7 * CAMERA.width * CAMERA.height
    assert len(np.unique(sums.cells().key)) == len(sums.cells())
