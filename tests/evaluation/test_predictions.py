"""The predictions of maps, Gaussians and finished grids for the voxels of a truth's lattice."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import gaussians, random_gaussians, write_standard_ply

import freeocc3d
from freeocc3d.core.errors import FreeOccError
from freeocc3d.core.transforms import quats_to_rotations, rotations_to_quats
from freeocc3d.core.types import Gaussians, PosedFrame
from freeocc3d.evaluation import predictions, scene_scoring, scoring
from freeocc3d.evaluation.confusion import Prediction
from freeocc3d.evaluation.ground_truth import save_ground_truth
from freeocc3d.evaluation.scored_classes import ClassMap, map_each_to_itself
from freeocc3d.evaluation.true_occupancy import GroundTruth
from freeocc3d.occupancy import carve, splat_reference
from freeocc3d.occupancy.splat import Options
from freeocc3d.settings import config
from freeocc3d.tracking.trajectory_alignment import (
    Poses,
    TrajectoryAlignment,
    align_trajectories,
    select_estimated_poses,
)

SHAPE = (40, 40, 48)
ORIGIN = np.array((-1.6, -1.6, 0.0))
QUARTER = np.array(((0, -1, 0), (1, 0, 0), (0, 0, 1.0)))
NO_CLASSES = ClassMap((), {})
SHORT = {"stop": 30, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}}


PAPERS = "occupancy.projection=probabilistic"
"""As Gaussians of other systems are scored."""


def lattice(origin: NDArray[np.float64] = ORIGIN, size: float = 0.08, shape: tuple[int, ...] = SHAPE) -> GroundTruth:
    return GroundTruth(np.zeros(shape, np.uint8), np.asarray(origin, float), size, ("free", "wall", "sofa"))


def turn(seed: int) -> NDArray[np.float64]:
    quat = np.random.default_rng(seed).normal(size=(1, 4))
    return np.asarray(quats_to_rotations(quat / np.linalg.norm(quat))[0])


def agreement(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Any:
    settings = {"capture": SHORT}
    return freeocc3d.reconstruct("builtin:room", tmp_path_factory.mktemp("maps") / "room", settings)


def of_room(room: Any, alignment: TrajectoryAlignment, truth: GroundTruth) -> NDArray[np.bool_]:
    settings = config.load_saved(room.path / "config.yaml")
    return predictions.predict_from_map(room, settings, alignment, truth, NO_CLASSES)[0].occupied


def test_a_similarity_of_map_and_lattice_changes_nothing(room: Any) -> None:
    same = of_room(room, TrajectoryAlignment.identity(), lattice())
    assert same.sum() > 500
    for scale in (0.5, 3.0):
        moved = TrajectoryAlignment(scale, np.eye(3), np.array((1.0, 2.0, 3.0)))
        scaled = of_room(room, moved, lattice(scale * ORIGIN + (1, 2, 3), 0.08 * scale))
        # Depth noise is absolute, so that the carving margin differs a little between scales.
        assert agreement(same, scaled) > 0.9
    turned = of_room(room, TrajectoryAlignment(1.0, QUARTER, np.zeros(3)), lattice())
    assert agreement(turned, np.rot90(same, 1, axes=(0, 1))) > 0.99


def test_a_map_on_its_own_lattice_is_the_map(room: Any) -> None:
    voxels = room.occupancy.occupied_voxels()
    low, high = voxels.min(axis=0), voxels.max(axis=0) + 1
    origin = room.occupancy.origin + low * 0.08
    on_lattice = of_room(room, TrajectoryAlignment.identity(), lattice(origin, shape=tuple(high - low)))
    expected = np.zeros(tuple(high - low), bool)
    expected[tuple((voxels - low).T)] = True
    # The map was carved by every frame, the score is by its keyframes: few voxels are contradicted by one alone.
    assert agreement(on_lattice, expected) > 0.99


def test_a_map_of_finer_cells_claims_the_same_voxels(room: Any, tmp_path: Path) -> None:
    cells = {"gaussians": {"cell_size": 0.02}, "capture": SHORT}
    fine = freeocc3d.reconstruct("builtin:room", tmp_path / "fine", cells)
    assert len(fine.gaussians) > 2.5 * len(room.gaussians)
    same, claimed = (of_room(scan_map, TrajectoryAlignment.identity(), lattice()) for scan_map in (room, fine))
    assert agreement(same, claimed) > 0.85


def test_the_rooms_map_agrees_with_its_truth(room: Any) -> None:
    capture = room.capture
    arrays = capture.ground_truth()  # type: ignore[attr-defined]
    truth = GroundTruth(arrays["labels"], arrays["origin"], arrays["voxel_size"], tuple(arrays["classes"].tolist()))
    scene = scene_scoring.score_map(room, truth, map_each_to_itself(truth.classes))
    assert scene.errors is not None
    assert scene.errors.ate_rmse_m < 0.01
    scored = scoring.Evaluation((scene,), truth.classes[1:], "se3")
    assert scored.scores.iou > 0.7
    assert scored.miou() is None  # the color encoder knows no furniture
    assert "knows none of the classes" in scored.notes[0]


def test_the_order_of_frames_does_not_count(room: Any) -> None:
    """Evidence is carved anew for the score; the true poses come in any order, too."""
    from freeocc3d.occupancy import build, splat

    order = np.random.default_rng(0).permutation(len(room.keyframes))
    frames, T = list(room.keyframes), room.trajectory.T_world_keyframe
    none = np.zeros((len(room.gaussians), 0), np.float16)
    usual, shuffled = (
        build.build_occupancy(
            room.gaussians,
            none,
            [PosedFrame(frames[i], T[i], i) for i in rows],
            splat.Options(),
            carve.Options(),
            ORIGIN,
        )
        for rows in (np.arange(len(order)), order)
    )
    np.testing.assert_array_equal(usual.state, shuffled.state)
    own = select_estimated_poses(room.trajectory)
    turned = Poses(own.timestamps[::-1], own.T_world_cam[::-1])
    scored = [scene_scoring.score_map(room, lattice(), NO_CLASSES, poses) for poses in (own, turned)]
    np.testing.assert_array_equal(scored[0].predicted.occupied, scored[1].predicted.occupied)


# Gaussians of any origin


def test_gaussians_are_projected_at_the_lattices_centers() -> None:
    some = random_gaussians(60, seed=3, extent=1.0)
    truth = lattice((-0.5, -0.5, -0.5), 0.05, (20, 20, 20))
    semantics = np.eye(2, dtype=np.float32)[np.arange(60) % 2]
    settings = config.load(None, [PAPERS, "occupancy.cutoff=8"])
    found = predictions.predict_from_gaussians(some, semantics, settings, TrajectoryAlignment.identity(), truth)
    points, wide = truth.centers().reshape(-1, 3), Options(cutoff=8.0, projection="probabilistic")
    expected = (splat_reference.compute_probability_reference(some, points, wide) >= wide.threshold).reshape(
        truth.shape
    )
    np.testing.assert_array_equal(found.occupied, expected)
    assert found.labels is not None
    nearest = (
        splat_reference.compute_posterior_mean_reference(some, points, semantics, wide)
        .argmax(axis=1)
        .reshape(truth.shape)
        + 1
    )
    np.testing.assert_array_equal(found.labels, np.where(expected, nearest, 0))


def test_gaussians_and_lattice_may_move_together() -> None:
    """x' = s R x + t, scales times s, rotations R R_g: a quarter turn and a scale permute the lattice exactly."""
    some = random_gaussians(80, seed=4, extent=1.2)
    truth = lattice((-0.8, -0.8, -0.8), 0.05, (32, 32, 32))
    settings = config.load(None, [PAPERS])
    here = predictions.predict_from_gaussians(some, None, settings, TrajectoryAlignment.identity(), truth).occupied
    moved = TrajectoryAlignment(2.0, QUARTER, np.array((5.0, -3.0, 1.0)))
    there = lattice(2.0 * truth.origin + moved.translation, 0.1, (32, 32, 32))
    turned = predictions.predict_from_gaussians(some, None, settings, moved, there).occupied
    assert 100 < here.sum() < here.size / 2
    assert agreement(turned, np.rot90(here, 1, axes=(0, 1))) > 0.998  # but for single precision at the threshold


def test_a_scaled_map_scores_what_its_shell_overlaps() -> None:
    """A Gaussian of standard deviation s is occupied within s sqrt(2 ln 2): scaled by 1.25, IoU is 1 / 1.25^3."""
    ball = gaussians((0.0, 0.0, 0.0), 1.0)
    truth = lattice((-2.0, -2.0, -2.0), 0.05, (80, 80, 80))
    settings = config.load(None, [PAPERS])
    small = predictions.predict_from_gaussians(ball, None, settings, TrajectoryAlignment.identity(), truth).occupied
    large = predictions.predict_from_gaussians(
        ball, None, settings, TrajectoryAlignment(1.25, np.eye(3), np.zeros(3)), truth
    ).occupied
    radius = np.sqrt(2 * np.log(2))
    assert small.sum() * 0.05**3 == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)
    assert agreement(small, large) == pytest.approx(1 / 1.25**3, rel=0.02)


def test_a_gaussian_far_larger_than_the_lattice_costs_no_memory() -> None:
    truth = lattice((0, 0, 0), 0.08, (10, 10, 10))
    huge = predictions.predict_from_gaussians(
        gaussians((0.0, 0, 0), 500.0), None, config.load(None, [PAPERS]), TrajectoryAlignment.identity(), truth
    )
    assert huge.occupied.all()
    far = predictions.predict_from_gaussians(
        gaussians((900.0, 0, 0), 1.0), None, config.load(None, [PAPERS]), TrajectoryAlignment.identity(), truth
    )
    assert not far.occupied.any()


def test_frames_are_fused_by_their_true_poses(tmp_path: Path) -> None:
    """The same world seen from two cameras, each Gaussian in one of the frames: fused, it is the world again."""
    world = random_gaussians(40, seed=5, extent=1.0)
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, :3] = turn(0), turn(1)
    T[:, :3, 3] = (0.3, -2.0, 1.0), (1.0, 1.0, 0.0)
    for index, rows in enumerate((slice(0, 25), slice(25, 40))):
        part = _seen_from(world[rows], T[index])
        np.savez(
            tmp_path / f"frame_{index}.npz",
            means=part.means, scales=part.scales, quats_wxyz=part.quats_wxyz, opacities=part.opacities,
            labels=np.full(len(part), index + 1),
        )  # fmt: skip
    truth, classes = lattice((-0.6, -0.6, -0.6), 0.06, (20, 20, 20)), map_each_to_itself(("free", "wall", "sofa"))
    settings = config.load(None, [PAPERS])
    fused, count = predictions.predict_from_frames(tmp_path, Poses(np.arange(2.0), T), settings, truth, classes)
    assert count == 2
    semantics = np.eye(2, dtype=np.float32)[(np.arange(40) >= 25).astype(int)]
    expected = predictions.predict_from_gaussians(world, semantics, settings, TrajectoryAlignment.identity(), truth)
    assert agreement(fused.occupied, expected.occupied) > 0.99
    both = fused.occupied & expected.occupied
    assert fused.labels is not None
    assert expected.labels is not None
    assert (fused.labels[both] == expected.labels[both]).mean() > 0.99
    _assert_ply_frames_are_the_same(tmp_path / "ply", world, T, truth, expected)


def _seen_from(world: Gaussians, T_world_cam: NDArray[np.float64]) -> Gaussians:
    R, t = T_world_cam[:3, :3], T_world_cam[:3, 3]
    rotations = R.T @ quats_to_rotations(world.quats_wxyz)
    quats = rotations_to_quats(rotations).astype(np.float32)
    return gaussians((world.means - t) @ R, world.scales, quats, world.opacities)


def _assert_ply_frames_are_the_same(
    folder: Path, world: Gaussians, T: NDArray[np.float64], truth: GroundTruth, expected: Prediction
) -> None:
    folder.mkdir()
    for index, rows in enumerate((slice(0, 25), slice(25, 40))):
        write_standard_ply(folder / f"{index:06d}.ply", _seen_from(world[rows], T[index]))
    fused, _ = predictions.predict_from_frames(
        folder, Poses(np.arange(2.0), T), config.load(None, [PAPERS]), truth, NO_CLASSES
    )
    assert fused.labels is None
    assert agreement(fused.occupied, expected.occupied) > 0.99


def test_unusable_frames_are_reported_in_a_sentence(tmp_path: Path) -> None:
    poses, settings, classes = (
        Poses(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1))),
        config.load(None, [PAPERS]),
        NO_CLASSES,
    )
    truth = lattice(shape=(4, 4, 4))
    with pytest.raises(FreeOccError, match="no per-frame Gaussians"):
        predictions.predict_from_frames(tmp_path, poses, settings, truth, classes)
    arrays = {
        "means": np.zeros((3, 3)), "scales": np.ones((3, 3)), "quats_wxyz": np.ones((3, 4)), "opacities": np.ones(3)
    }  # fmt: skip
    np.savez(tmp_path / "7.npz", **arrays)
    with pytest.raises(FreeOccError, match="number of a frame with a true pose"):
        predictions.predict_from_frames(tmp_path, poses, settings, truth, classes)
    np.savez(tmp_path / "1.npz", **(arrays | {"scales": np.ones((2, 3))}))
    with pytest.raises(FreeOccError, match=r"'scales' of .*\(3, 3\)"):
        predictions.predict_from_frames(tmp_path, poses, settings, truth, classes)
    np.savez(tmp_path / "1.npz", **arrays, labels=np.full(3, 9))
    with pytest.raises(FreeOccError, match="label 9, but 0 classes"):
        predictions.predict_from_frames(tmp_path, poses, settings, truth, classes)
    np.savez(tmp_path / "1.npz", **arrays, semantics=np.ones((3, 5)))
    with pytest.raises(FreeOccError, match="'semantics'"):
        predictions.predict_from_frames(tmp_path, poses, settings, truth, classes)


# Finished grids


def grid_file(path: Path, labels: NDArray[np.uint8], origin: object, size: float = 0.08) -> Path:
    save_ground_truth(GroundTruth(labels, np.asarray(origin, float), size, ("free", "Wall", "sofa")), path, True)
    return path


def test_a_grid_is_read_where_its_voxels_are(tmp_path: Path) -> None:
    labels = np.random.default_rng(0).choice(np.array([0, 1, 2, 255], np.uint8), (6, 7, 8))
    classes = map_each_to_itself(("free", "wall", "sofa"))
    same, note = predictions.predict_from_grid(
        grid_file(tmp_path / "g.npz", labels, ORIGIN), TrajectoryAlignment.identity(), lattice(shape=(6, 7, 8)), classes
    )
    np.testing.assert_array_equal(same.occupied, (labels == 1) | (labels == 2))
    np.testing.assert_array_equal(same.labels, np.where(labels == 255, 0, labels))
    assert note == ""
    shifted, note = predictions.predict_from_grid(
        grid_file(tmp_path / "g.npz", labels, ORIGIN + (0.08, 0, -0.16)),
        TrajectoryAlignment.identity(),
        lattice(shape=(6, 7, 8)),
        classes,
    )
    np.testing.assert_array_equal(shifted.occupied[1:, :, :6], same.occupied[:-1, :, 2:])
    assert not shifted.occupied[0].any()
    assert note == ""
    _, note = predictions.predict_from_grid(
        grid_file(tmp_path / "g.npz", labels, ORIGIN + 0.02),
        TrajectoryAlignment.identity(),
        lattice(shape=(6, 7, 8)),
        classes,
    )
    assert "up to 0.25 voxels apart" in note


def test_a_grid_is_moved_by_its_alignment(tmp_path: Path) -> None:
    labels = np.random.default_rng(1).choice(np.array([0, 1], np.uint8), (10, 10, 4))
    truth = lattice((-0.4, -0.4, 0), 0.08, (10, 10, 4))
    path = grid_file(tmp_path / "g.npz", labels, truth.origin)
    turned, _ = predictions.predict_from_grid(path, TrajectoryAlignment(1.0, QUARTER, np.zeros(3)), truth, NO_CLASSES)
    np.testing.assert_array_equal(turned.occupied, np.rot90(labels, 1, axes=(0, 1)) == 1)
    assert turned.labels is None


def test_an_export_is_scored_like_the_map_it_shows(room: Any, tmp_path: Path) -> None:
    from freeocc3d.export import export_map

    export_map(room, "npz", tmp_path / "room.npz")
    origin = np.load(tmp_path / "room.npz")["origin"]
    shape = np.load(tmp_path / "room.npz")["occupancy"].shape
    claimed, _ = predictions.predict_from_grid(
        tmp_path / "room.npz",
        TrajectoryAlignment.identity(),
        lattice(origin, shape=shape),
        NO_CLASSES,
        with_trajectory=True,
    )
    assert claimed.occupied.sum() == len(room.occupancy.occupied_voxels())


def test_grids_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    labels = np.zeros((3, 3, 3), np.uint8)
    with pytest.raises(FreeOccError, match=r"voxels of 0\.1 m, the ground truth of 0\.08 m"):
        predictions.predict_from_grid(
            grid_file(tmp_path / "g.npz", labels, ORIGIN, 0.1), TrajectoryAlignment.identity(), lattice(), NO_CLASSES
        )
    np.savez(tmp_path / "flat.npz", labels=labels[0], origin=ORIGIN, voxel_size=np.float64(0.08))
    with pytest.raises(FreeOccError, match="whole numbers"):
        predictions.predict_from_grid(tmp_path / "flat.npz", TrajectoryAlignment.identity(), lattice(), NO_CLASSES)
    np.savez(tmp_path / "bare.npz", grid=labels, origin=ORIGIN, voxel_size=np.float64(0.08))
    with pytest.raises(FreeOccError, match="no 'labels'"):
        predictions.predict_from_grid(tmp_path / "bare.npz", TrajectoryAlignment.identity(), lattice(), NO_CLASSES)


def test_another_systems_map_is_scored_through_its_trajectory(room: Any, tmp_path: Path) -> None:
    """The room's Gaussians as a 3DGS PLY, in a world of another scale, with that world's trajectory."""
    other = TrajectoryAlignment(0.5, turn(7), np.array((3.0, 4.0, 5.0)))
    from freeocc3d.gaussians.anchors import align_gaussians

    ply = write_standard_ply(
        tmp_path / "map.ply", align_gaussians(room.gaussians, other.scale, other.rotation, other.translation)
    )
    own = select_estimated_poses(room.trajectory)
    theirs = Poses(own.timestamps, other.poses(own.T_world_cam))
    direct = predictions.predict_from_gaussians(
        room.gaussians, None, config.load(None, [PAPERS]), TrajectoryAlignment.identity(), lattice()
    )
    scene = scene_scoring.score_gaussians(ply, lattice(), NO_CLASSES, theirs, own, "sim3")
    assert scene.alignment.scale == pytest.approx(2.0)
    assert agreement(scene.predicted.occupied, direct.occupied) > 0.995
    wrong = scene_scoring.score_gaussians(ply, lattice(), NO_CLASSES, theirs, own, "se3")
    assert agreement(wrong.predicted.occupied, direct.occupied) < 0.5
    assert align_trajectories(theirs, own, "sim3").scale == pytest.approx(2.0)
    with pytest.raises(FreeOccError, match="--trajectory"):
        scene_scoring.score_gaussians(ply, lattice(), NO_CLASSES, None, own)
    with pytest.raises(FreeOccError, match="--poses"):
        scene_scoring.score_gaussians(ply, lattice(), NO_CLASSES, theirs, None)
