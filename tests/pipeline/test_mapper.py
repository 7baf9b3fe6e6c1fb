"""The mapper as a live camera drives it: frames one by one, and all four layers of the frames so far."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pipeline_runs import ROOM

from freeocc3d.capture import open_capture
from freeocc3d.core.transforms import invert
from freeocc3d.core.types import OCCUPIED, Gaussians, Occupancy
from freeocc3d.pipeline.mapper import Mapper
from freeocc3d.settings import config

MOMENTS = (4, 9)
"""Frames after which the layers are asked for."""


@pytest.fixture(scope="module")
def layers(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Mapper, Gaussians, np.ndarray, Occupancy]]:
    """The mapper after the last frame, and at each moment the Gaussians, their features and the occupancy."""
    settings = config.resolve({**ROOM, "language": {"encoder": "color"}})
    capture = open_capture("builtin:room", settings.capture, settings.backends["capture"])
    mapper = Mapper(settings, capture, tmp_path_factory.mktemp("live"))
    encoder = settings.load_backend("language", capture)
    found = []
    for index in range(0, 2 * MOMENTS[-1], 2):
        mapper.add(capture[index])
        if index // 2 + 1 in MOMENTS:
            gaussians = mapper.fit_gaussians(mapper.anchor_gaussians())
            features = mapper.build_features(gaussians, encoder)
            found.append((mapper, gaussians, features, mapper.build_occupancy(gaussians, features)))
    return found


def test_a_mapper_that_takes_frames_needs_no_preparation(layers) -> None:
    mapper = layers[0][0]
    assert not mapper.offline
    assert np.flatnonzero(mapper.trajectory().has_pose).tolist() == list(range(0, 2 * MOMENTS[-1], 2))
    assert len(mapper.keyframes) == len(mapper.trajectory().keyframes)


def test_all_layers_are_there_at_each_moment(layers) -> None:
    for _, gaussians, features, occupancy in layers:
        assert len(gaussians) > 300
        assert len(features) == len(gaussians)
        lengths = np.linalg.norm(features.astype(float), axis=1)
        seen = lengths > 0
        assert seen.mean() > 0.5
        np.testing.assert_allclose(lengths[seen], 1, atol=0.01)
        assert len(occupancy.features) == len(occupancy.occupied_voxels()) > 200


def test_more_frames_show_more(layers) -> None:
    (_, early, _, first), (_, late, _, second) = layers
    assert len(late) > len(early)
    assert np.count_nonzero(second.state == OCCUPIED) > np.count_nonzero(first.state == OCCUPIED)


def test_gaussians_stay_at_their_anchors(layers) -> None:
    mapper, gaussians = layers[-1][:2]
    T = mapper.trajectory().T_world_keyframe[gaussians.anchor_keyframe]
    world = np.einsum("nij,nj->ni", T[:, :3, :3], gaussians.anchor_cam.astype(float)) + T[:, :3, 3]
    np.testing.assert_allclose(world, gaussians.means, atol=1e-4)


def test_after_a_refinement_the_map_stands_upright(layers) -> None:
    """In the world of the built-in room, z is up, and walls lie along x and y. These frames show a table, no floor."""
    mapper = layers[-1][0]
    mapper.refine()
    upright, after, before = mapper.upright, mapper.trajectory(), mapper.tracker.trajectory(mapper.capture.timestamps)
    assert upright is not None
    assert (upright.by in ("floor", "level surfaces"), upright.floor, upright.walls) == (True, True, True)
    posed = np.flatnonzero(before.has_pose)
    moved = upright.T_upright_world @ before.T_world_cam[posed]
    np.testing.assert_allclose(after.T_world_cam[posed], moved, atol=1e-9)
    T_map_true = after.T_world_cam[posed] @ invert(np.stack([mapper.capture.pose(i) for i in posed.tolist()]))
    assert np.abs(T_map_true[:, 2, :3] - (0, 0, 1)).max() < 0.02
    assert np.abs(np.sort(np.abs(T_map_true[:, 0, :3])) - (0, 0, 1)).max() < 0.02
    frames = mapper.submaps()[0].frames
    np.testing.assert_allclose(mapper.submaps()[0].T_submap_cam, after.T_world_cam[frames], atol=1e-9)
    z = mapper.anchor_gaussians().means[:, 2]
    assert np.mean(np.abs(z) < 0.01) > 0.1  # the table


def test_a_restored_mapper_goes_on_where_it_was(layers, tmp_path: Path) -> None:
    mapper = layers[-1][0]
    mapper.refine()
    again = Mapper(mapper.settings, mapper.capture, mapper.keyframes.folder.parent)
    assert again.restore(mapper.state(MOMENTS[-1])) == MOMENTS[-1]
    np.testing.assert_array_equal(again.trajectory().T_world_cam, mapper.trajectory().T_world_cam)
    np.testing.assert_array_equal(again.origin, mapper.origin)
    larger = mapper.settings.changed("occupancy", voxel_size=0.2)
    again = Mapper(larger, mapper.capture, mapper.keyframes.folder.parent)
    again.restore(mapper.state(MOMENTS[-1]))
    assert again.origin[2] == pytest.approx(-0.2 / 3)  # as in a run that has these voxels from its start
