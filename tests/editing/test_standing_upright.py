"""A map of an earlier version, in the frame of its first camera, stands upright after it was rebuilt."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from command_line import refused, run

from freeocc3d.core.errors import MapError
from freeocc3d.core.transforms import invert
from freeocc3d.core.types import OCCUPIED
from freeocc3d.editing.standing_upright import read_keyframes, stand_upright
from freeocc3d.gaussians import anchors
from freeocc3d.language.feature_codec import Codec
from freeocc3d.occupancy import build
from freeocc3d.query.scan_map import Map, load_map
from freeocc3d.storage.manifest import Manifest, Refined, matrix
from freeocc3d.storage.work_folder import WorkFolder
from freeocc3d.storage.writer import MapParts, write_changed_map


@pytest.fixture(scope="module")
def lying(room: Map, tmp_path_factory: pytest.TempPathFactory) -> Map:
    """The room as earlier versions kept it: in the frame of the first camera, with voxels cut askew."""
    path = tmp_path_factory.mktemp("lying") / "room"
    T, said = room.T_first_camera, room.manifest
    assert T is not None
    trajectory = replace(room.trajectory, T_world_cam=T @ room.trajectory.T_world_cam)
    gaussians = anchors.align_gaussians(room.gaussians, 1.0, T[:3, :3], T[:3, 3])
    features, settings = room.gaussian_features, room.settings
    frames = read_keyframes(room, trajectory.T_world_keyframe)
    occupancy = build.build_occupancy(gaussians, features, frames, settings.occupancy, settings.carving)
    facts = {name: getattr(said, name) for name in Manifest.__struct_fields__}
    facts |= {"upright": None, "T_first_camera": None, "T_gravity_map": matrix(invert(T)), "frame": "first camera"}
    facts |= {"up": tuple(T[:3, 2].tolist()), "T_world_map": matrix(np.array(said.T_world_map) @ invert(T))}
    with WorkFolder.made_of(room.path, path, False) as work:
        parts = MapParts(
            Manifest(**facts), settings, lambda: room.report, occupancy, Codec.fit(features), features, gaussians,
            trajectory,
        )  # fmt: skip
        write_changed_map(room, work, path, parts)
    return load_map(path)


@pytest.fixture(scope="module")
def again(lying: Map, tmp_path_factory: pytest.TempPathFactory) -> Map:
    return stand_upright(lying, tmp_path_factory.mktemp("upright") / "room")


def test_the_frame_is_found_again(room: Map, again: Map) -> None:
    made, before = again.manifest, room.manifest
    assert made.upright is not None
    assert (made.upright.by, made.frame) == ("floor", "z up, the floor at z = 0, walls along x and y")
    unsure = msgspec.structs.replace(made.upright, floor=False, walls=False)
    assert unsure.in_words == "z up, the lowest points at z = 0, x along the first view"
    np.testing.assert_allclose(again.trajectory.T_world_cam, room.trajectory.T_world_cam, atol=1e-3)
    for name in ("T_world_map", "T_first_camera"):
        np.testing.assert_allclose(getattr(made, name), getattr(before, name), atol=1e-3)
    assert (made.up, made.origin[2]) == ((0, 0, 1), pytest.approx(-0.08 / 3))
    np.testing.assert_array_equal(again.T_gravity_map, np.eye(4))
    assert again.report["upright"] == msgspec.to_builtins(made.upright)


def test_the_voxels_are_those_of_a_map_that_was_made_upright(room: Map, again: Map) -> None:
    shift = np.abs(np.array(again.manifest.origin) - room.manifest.origin)
    assert shift.max() < 0.005
    found, wanted = ({tuple(voxel) for voxel in made.occupancy.voxels(OCCUPIED).tolist()} for made in (again, room))
    assert len(found & wanted) / len(found | wanted) > 0.9


def test_gaussians_stay_at_their_anchors(again: Map) -> None:
    gaussians, poses = again.gaussians, again.trajectory.T_world_keyframe
    moved = np.einsum("nij,nj->ni", poses[gaussians.anchor_keyframe, :3, :3], gaussians.anchor_cam.astype(float))
    np.testing.assert_allclose(moved + poses[gaussians.anchor_keyframe, :3, 3], gaussians.means, atol=1e-4)


def test_what_cannot_stand_upright_is_refused(room: Map, lying: Map, tmp_path: Path) -> None:
    assert "stands upright already" in refused("upright", room.path, "-o", tmp_path / "m")
    box = Refined(map="whole", box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0))
    part = Map(lying.path, msgspec.structs.replace(lying.manifest, refined=box))
    with pytest.raises(MapError, match="the map of a box: let whole stand upright first"):
        stand_upright(part, tmp_path / "m")
    assert "upright    no: an earlier map" in run("info", lying.path).stdout
    assert "upright    z up by the floor" in run("info", room.path).stdout
