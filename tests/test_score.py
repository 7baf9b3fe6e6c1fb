"""A map on a truth's lattice, in a frame of another scale and rotation."""

import numpy as np
import pytest

import freeocc3d
from freeocc3d.evaluation.align import Alignment, align_trajectory, true_poses
from freeocc3d.evaluation.iou import occupancy_iou
from freeocc3d.evaluation.score import occupied_on_lattice


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    settings = {"capture": {"stop": 30, "synthetic": {"width": 160, "height": 120}}}
    return freeocc3d.reconstruct("builtin:room", tmp_path_factory.mktemp("maps") / "room", settings)


def alignment(scale: float, R: np.ndarray, t: np.ndarray) -> Alignment:
    return Alignment(scale, R, t, 0.0, 30)


def test_a_similarity_of_map_and_lattice_changes_nothing(room) -> None:
    origin, shape = np.array((-1.6, -1.6, 0.0)), (40, 40, 48)
    same = occupied_on_lattice(room, alignment(1.0, np.eye(3), np.zeros(3)), origin, shape, 0.08)
    assert same.sum() > 500
    for scale in (0.5, 3.0):
        scaled = occupied_on_lattice(
            room,
            alignment(scale, np.eye(3), np.array((1.0, 2.0, 3.0))),
            scale * origin + (1, 2, 3),
            shape,
            0.08 * scale,
        )
        # Depth noise is absolute, so that the carving margin differs a little between scales.
        assert (same & scaled).sum() / (same | scaled).sum() > 0.9
    quarter = np.array(((0, -1, 0), (1, 0, 0), (0, 0, 1.0)))
    turned = occupied_on_lattice(room, alignment(1.0, quarter, np.zeros(3)), np.array((-1.6, -1.6, 0.0)), shape, 0.08)
    expected = np.rot90(same, 1, axes=(0, 1))
    assert (turned & expected).sum() / (turned | expected).sum() > 0.99


def test_the_rooms_map_agrees_with_its_truth(room) -> None:
    from freeocc3d import config, registry
    from freeocc3d.capture import base, open_capture

    settings = config.load(room.path / "config.yaml")
    own = registry.build_options(base, config.options(settings, "capture"))
    capture = open_capture("builtin:room", own, settings["capture"])
    truth = capture.ground_truth()
    fitted = align_trajectory(room.trajectory, true_poses(capture), False)
    assert fitted.ate_rmse_m < 0.01
    occupied = occupied_on_lattice(room, fitted, truth["origin"], truth["labels"].shape, truth["voxel_size"])
    score = occupancy_iou(truth["labels"], occupied)
    assert score.iou > 0.7
