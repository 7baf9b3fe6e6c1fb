"""Whole evaluations: pooled scenes, class lists, real captures, and inputs that do not match."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import refused, run
from small_captures import data_folder

import freeocc3d
from freeocc3d.cli.scores import scores_document, scores_lines
from freeocc3d.core.errors import FreeOccError
from freeocc3d.core.tum_files import write_tum
from freeocc3d.core.types import Trajectory
from freeocc3d.evaluation import scoring
from freeocc3d.evaluation.confusion import Prediction
from freeocc3d.evaluation.ground_truth import load_ground_truth, save_ground_truth
from freeocc3d.evaluation.scene_scoring import ScoredScene
from freeocc3d.evaluation.scored_classes import map_each_to_itself
from freeocc3d.evaluation.scoring import Evaluation, ScoringRequest, evaluate_scenes
from freeocc3d.evaluation.true_occupancy import GroundTruth
from freeocc3d.query.scan_map import load_map
from freeocc3d.tracking.trajectory_alignment import TrajectoryAlignment

CLASSES = Path(__file__).parents[2] / "configs" / "classes" / "house_to_embodiedocc.yaml"


def scene(
    labels: list[int], claimed: list[int] | None, classes: tuple[str, ...], name: str = "a", frames: object = None
) -> ScoredScene:
    """A scene of a row of voxels; claims are classes, 99 = occupied by no known class."""
    true = np.array(labels, np.uint8).reshape(-1, 1, 1)
    mask = None if frames is None else np.array(frames, bool).reshape(true.shape)
    own = np.array(claimed if claimed is not None else labels).reshape(true.shape)
    predicted = Prediction(
        (own > 0) & (own < 255), None if claimed is None else np.where(own == 99, 0, own).astype("u1")
    )
    return ScoredScene(
        name, GroundTruth(true, np.zeros(3), 0.1, ("free", *classes), mask), predicted, TrajectoryAlignment.identity(),
        None, None, None, np.array((0.0, 0.0, 1.0)), (),
    )  # fmt: skip


def test_scenes_are_pooled_by_voxels_and_absent_classes_count_zero_in_a_list() -> None:
    classes = ("wall", "sofa", "lamp")
    one = scene([1, 1, 1, 0, 255], [1, 1, 99, 0, 1], classes)
    two = scene([2, 2, 0, 0], [2, 0, 1, 0], classes, "b")
    pooled = Evaluation((one, two), classes, "none")
    # wall: 2 hits of 3 true, 1 invented; sofa: 1 hit of 2 true.
    assert pooled.miou() == pytest.approx((2 / 4 + 1 / 2) / 2)
    assert pooled.classes_in_miou == ("wall", "sofa")
    assert pooled.absent == ("lamp",)
    assert pooled.miou(classes) == pytest.approx((2 / 4 + 1 / 2) / 3)
    assert Evaluation((one, two), classes, "none", listed=True).miou() == pytest.approx((2 / 4 + 1 / 2) / 3)
    assert pooled.scores.iou == pytest.approx(4 / 6)
    document = scores_document(pooled)
    assert document["per_class"] == {"wall": pytest.approx(0.5), "sofa": pytest.approx(0.5)}
    assert [own["iou"] for own in document["scenes"]] == [1.0, pytest.approx(1 / 3)]
    reordered = scores_document(Evaluation((two, one), classes, "none"))
    for name in ("iou", "miou", "precision", "recall", "per_class", "confusion", "by_mask"):
        assert reordered[name] == document[name]


def test_both_masks_stand_side_by_side() -> None:
    masked = scene([1, 1, 0, 0, 255], [1, 0, 1, 0, 1], ("wall",), frames=[1, 0, 0, 1, 1])
    document = scores_document(Evaluation((masked,), ("wall",), "none"))
    assert document["mask"] == "label"
    assert document["by_mask"]["label"]["iou"] == document["iou"] == pytest.approx(1 / 3)
    assert document["by_mask"]["frames"] == {"iou": 1.0, "miou": 1.0, "precision": 1.0, "recall": 1.0, "voxels": 2}


def test_lists_of_classes_over_which_miou_is_given() -> None:
    classes = tuple(f"class {k}" for k in range(1, 13))
    labels = [k for k in range(1, 13) for _ in range(13 - k)]
    wrong = [0 if k == 11 else k for k in labels]
    scored = Evaluation((scene(labels, wrong, classes),), classes, "none")
    assert scored.miou_over["top_10"] == classes[:10]
    assert scored.miou(scored.miou_over["top_10"]) == 1.0
    assert scored.miou() == pytest.approx(11 / 12)
    assert scored.miou_over["top_20"] is None
    assert scored.miou_over["shared_8"] is None
    assert "top_20, top_30, top_40 (the truth holds 12 classes)" in "\n".join(scores_lines(scored))


def test_a_claim_without_classes_has_no_miou_which_is_not_zero() -> None:
    scored = Evaluation((scene([1, 0], None, ("wall",)),), ("wall",), "none")
    document = scores_document(scored)
    assert document["miou"] is None
    assert document["per_class"] == {}
    assert document["classes_in_miou"] == []
    assert document["iou"] == 1.0
    assert "mIoU           –" in "\n".join(scores_lines(scored))


@pytest.fixture(scope="module")
def bedroom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of a part of a real capture, with its classes."""
    path = tmp_path_factory.mktemp("evaluate") / "bedroom"
    settings = {"capture": {"stop": 60, "stride": 4}, "language": {"encoder": "labels"}, "fitting": {"passes": 0}}
    freeocc3d.reconstruct(data_folder() / "house" / "bedroom", path, settings)
    return path


def test_the_command_scores_a_map_against_its_captures_truth(bedroom: Path, tmp_path: Path) -> None:
    document = json.loads(run("evaluate", bedroom, "--json").stdout)
    assert 0.1 < document["iou"] < 0.9  # a quarter of the walk
    assert document["precision"] > 0.75
    assert document["ate_rmse_m"] < 0.02
    assert (document["frames"], document["frames_with_pose"]) == (261, 15)
    assert document["trajectory"]["frames_matched"] == 15
    assert set(document["by_mask"]) == {"label"}
    assert document["align"] == "se3"
    assert document["alignment"]["scale"] == 1.0
    assert document["miou"] == pytest.approx(np.mean([document["per_class"][c] for c in document["classes_in_miou"]]))
    page = tmp_path / "report.html"
    run("evaluate", bedroom, "--html", page)
    written = page.read_text()
    assert f"{100 * document['iou']:.1f} %" in written
    assert written.count("data:image/png;base64,") == 3
    assert f"{page} already exists" in refused("evaluate", bedroom, "--html", page)
    assert page.read_text() == written
    truth = data_folder() / "house" / "bedroom" / "ground_truth.npz"
    mapped = run("evaluate", bedroom, "--ground-truth", truth, "--classes", CLASSES).stdout
    assert "11 classes: ceiling, floor, wall" in mapped
    assert "shared_8" in mapped
    assert "cannot name" not in mapped


def test_the_truth_as_prediction_scores_100_everywhere() -> None:
    for name in ("house/bedroom", "house/living", "7scenes-kitchen"):
        truth = data_folder() / name / "ground_truth.npz"
        document = json.loads(
            run("evaluate", "--grid", truth, "--ground-truth", truth, "--align", "none", "--json").stdout
        )
        for figure in ("iou", "precision", "recall", "miou"):
            assert document[figure] == 1.0, name
        assert set(document["per_class"].values()) == {1.0}
        assert all(own is None or own["miou"] == 1.0 for key, own in document["miou_over"].items() if key != "listed")


NAMES = ("free", "wall", "sofa", "lamp")


def some_truth(seed: int = 0, classes: tuple[str, ...] = NAMES) -> GroundTruth:
    """Patches of free, unknown and occupied voxels."""
    rng = np.random.default_rng(seed)
    values = rng.choice([0, 0, 0, 1, 1, 2, 3, 255], (7, 6, 5))
    labels = np.repeat(np.repeat(np.repeat(values, 3, axis=0), 2, axis=1), 2, axis=2)
    return GroundTruth(np.minimum(labels, 255).astype(np.uint8), np.array((0.5, -1.0, 2.0)), 0.08, classes)


def saved(truth: GroundTruth, path: Path) -> Path:
    save_ground_truth(truth, path, True)
    return path


def test_a_shifted_and_a_swapped_truth_score_what_numpy_counts(tmp_path: Path) -> None:
    truth = some_truth()
    known = truth.labels != 255
    there = saved(truth, tmp_path / "truth.npz")

    def scored(labels: Any, origin: Any = truth.origin) -> dict[str, Any]:
        claim = saved(GroundTruth(labels, origin, 0.08, truth.classes), tmp_path / "claim.npz")
        return scores_document(evaluate_scenes(ScoringRequest(grid=claim, ground_truths=[there])))

    occupied = known & (truth.labels > 0)
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = 0.08
        moved = np.roll(np.where(known, truth.labels, 0), 1, axis)
        moved[tuple(slice(0, 1) if a == axis else slice(None) for a in range(3))] = 0
        expected = ((moved > 0) & occupied).sum() / (((moved > 0) | occupied) & known).sum()
        document = scored(truth.labels, truth.origin + shift)
        assert document["iou"] == pytest.approx(expected, abs=1e-12)
        assert list(document["per_class"]) == list(NAMES[1:])
        for label, name in enumerate(NAMES[1:], start=1):
            own = (moved == label) & known
            of_class = (own & (truth.labels == label)).sum() / (own | (truth.labels == label)).sum()
            assert document["per_class"][name] == pytest.approx(of_class, abs=1e-12)
    flipped = truth.labels[::-1]
    claimed = (flipped > 0) & (flipped < 255)
    expected = (claimed & occupied).sum() / ((claimed | occupied) & known).sum()
    assert scored(np.ascontiguousarray(flipped))["iou"] == pytest.approx(expected, abs=1e-12)


def test_a_class_file_says_which_classes_are_scored(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("classes: [furniture, wall, carpet]\nmap: {sofa: furniture, lamp: null}\n")
    there = saved(some_truth(), tmp_path / "truth.npz")
    found = evaluate_scenes(ScoringRequest(grid=there, ground_truths=[there], classes=tmp_path / "c.yaml"))
    assert (found.classes, found.listed, found.how) == (("furniture", "wall", "carpet"), True, "se3")
    assert found.scores.iou == pytest.approx(1.0)
    assert found.miou() == pytest.approx(2 / 3)  # no carpet
    plain = evaluate_scenes(ScoringRequest(grid=there, ground_truths=[there], align="none"))
    assert (plain.classes, plain.listed, plain.how) == (NAMES[1:], False, "none")
    assert plain.miou() == pytest.approx(1.0)


def test_classes_of_several_truths_are_put_together_in_their_order() -> None:
    truths = [some_truth(0), some_truth(1, ("free", "lamp", "plant", "wall"))]
    common = scoring.collect_common_classes(truths)
    assert common.classes == ("wall", "sofa", "lamp", "plant")
    applied = common.apply(truths[1], "")
    np.testing.assert_array_equal(applied.labels, np.array((0, 3, 4, 1, *[255] * 252))[truths[1].labels])


def test_requests_that_cannot_be_scored_are_told_in_a_sentence(tmp_path: Path) -> None:
    there = saved(some_truth(), tmp_path / "truth.npz")
    empty = tmp_path / "capture"
    empty.mkdir()
    for asked, said in (
        (ScoringRequest(grid=there, ground_truths=[there, there]), "2 ground truths are given for 1 scenes"),
        (ScoringRequest(grid=there, ground_truths=[there], poses=["a", "b"]), "--poses is given 2 times for 1 scenes"),
        (ScoringRequest(ground_truths=[there]), "There is nothing to score"),
        (ScoringRequest(frames=empty, ground_truths=[there]), "need true poses"),
        (ScoringRequest(grid=tmp_path / "none.npz", ground_truths=[there]), "no file or folder .*none"),
        (ScoringRequest(grid=there), "no capture holds it"),
        (ScoringRequest(grid=there, poses=[str(empty)]), "ground_truth.npz does not exist"),
    ):
        with pytest.raises(FreeOccError, match=said):
            evaluate_scenes(asked)


def test_maps_are_pooled_and_a_split_must_be_whole(bedroom: Path, tmp_path: Path) -> None:
    one = evaluate_scenes(ScoringRequest(maps=[bedroom]))
    two = evaluate_scenes(ScoringRequest(maps=[bedroom, bedroom]))
    np.testing.assert_array_equal(two.scores.matrix, 2 * one.scores.matrix)
    assert scores_document(two)["frames_with_pose"] == 30
    assert two.ate_rmse_m == pytest.approx(one.ate_rmse_m)
    (tmp_path / "split.txt").write_text("bedroom\n")
    assert evaluate_scenes(ScoringRequest(maps=[bedroom], split=tmp_path / "split.txt")).scores.iou == one.scores.iou
    (tmp_path / "split.txt").write_text("bedroom\nscene0011_00\n")
    with pytest.raises(FreeOccError, match="scene0011_00"):
        evaluate_scenes(ScoringRequest(maps=[bedroom], split=tmp_path / "split.txt"))


def test_truth_and_maps_that_do_not_fit_are_reported_in_a_sentence(bedroom: Path, tmp_path: Path) -> None:
    house = data_folder() / "house"
    truth = house / "bedroom" / "ground_truth.npz"
    assert "given 2 times for 1" in refused(
        "evaluate", bedroom, "--poses", house / "living", "--poses", house / "living"
    )
    (tmp_path / "two.txt").write_text("0 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    assert "at least 3" in refused("evaluate", bedroom, "--poses", tmp_path / "two.txt")
    line = "".join(f"{2 * i} {i} 0 0 0 0 0 1\n" for i in range(20))
    (tmp_path / "line.txt").write_text(line)
    assert "on one line" in refused("evaluate", bedroom, "--poses", tmp_path / "line.txt")
    (tmp_path / "late.txt").write_text(line.replace("\n", "\n9", 1))
    assert "se3, sim3, none" in refused("evaluate", bedroom, "--align", "affine")
    assert "no such file" in refused("evaluate", bedroom, "--ground-truth", tmp_path / "absent.npz")
    assert "are given for 1 scenes" in refused("evaluate", bedroom, "--ground-truth", truth, "--ground-truth", truth)
    (tmp_path / "few.yaml").write_text("[wall, floor]\n")
    assert "'bed'" in refused("evaluate", bedroom, "--classes", tmp_path / "few.yaml")
    assert "--poses" in refused("evaluate", "--frames", tmp_path, "--ground-truth", truth)
    assert "did you mean 'threshold'" in refused("evaluate", bedroom, "--set", "occupancy.treshold=0.3")
    moved = tmp_path / "moved"
    shutil.copytree(bedroom, moved)
    manifest = (moved / "map.yaml").read_text().rpartition("# xxh3")[0]
    (moved / "map.yaml").write_text(manifest.replace("house/bedroom", "house/gone"))
    assert "no longer exists. Name the true poses with --poses" in refused("evaluate", moved, "--ground-truth", truth)
    assert "name it with --ground-truth" in refused("evaluate", moved)
    assert run("evaluate", bedroom, "--grid", truth, code=2).stderr
    assert run("evaluate", code=2).stderr
    (tmp_path / "zero.txt").write_text("".join(f"{i} {i} {i * i} 0 0 0 0 0\n" for i in range(20)))
    assert "is not a trajectory" in refused("evaluate", bedroom, "--poses", tmp_path / "zero.txt")
    assert "There is no" in refused("evaluate", "--gaussians", tmp_path / "absent.ply", "--ground-truth", truth)
    assert "there is no folder" in refused("evaluate", bedroom, "--html", tmp_path / "absent" / "page.html")
    arrays = dict(np.load(truth))
    np.savez(tmp_path / "fine.npz", **{**arrays, "voxel_size": np.float64(1e-9)})
    assert "from 0.001 to 10" in refused("evaluate", bedroom, "--ground-truth", tmp_path / "fine.npz")


def test_a_map_that_misses_the_truth_altogether_says_so(bedroom: Path, tmp_path: Path) -> None:
    arrays = dict(np.load(data_folder() / "house" / "bedroom" / "ground_truth.npz"))
    np.savez(tmp_path / "away.npz", **{**arrays, "origin": arrays["origin"] + 1000})
    result = evaluate_scenes(ScoringRequest(maps=[bedroom], ground_truths=[tmp_path / "away.npz"]))
    assert result.scores.iou == 0
    assert any("no occupied voxel inside the truth" in note for note in result.notes)
    assert not any(
        "no occupied voxel inside the truth" in note for note in evaluate_scenes(ScoringRequest(maps=[bedroom])).notes
    )


def test_a_map_whose_timestamps_rarely_match_says_so(bedroom: Path, tmp_path: Path) -> None:
    estimated = load_map(bedroom).trajectory
    rows = np.flatnonzero(estimated.has_pose)
    times = np.where(np.arange(len(rows)) < 4, estimated.timestamps[rows], 1e4 + np.arange(len(rows)))
    n = len(rows)
    written = Trajectory(times, estimated.T_world_cam[rows], np.zeros(0, np.int32), np.full(n, "tracked"), np.ones(n))
    write_tum(tmp_path / "poses.txt", written)
    notes = evaluate_scenes(ScoringRequest(maps=[bedroom], poses=[str(tmp_path / "poses.txt")])).notes
    assert any(f"Only 4 of {n} estimated poses" in note for note in notes)


def test_the_threshold_can_be_swept_without_mapping_again(bedroom: Path) -> None:
    strict = evaluate_scenes(ScoringRequest(maps=[bedroom], overrides=["occupancy.threshold=0.9"]))
    usual = evaluate_scenes(ScoringRequest(maps=[bedroom]))
    assert strict.scores.recall < usual.scores.recall
    assert strict.scores.precision > usual.scores.precision


def test_the_ground_truth_command_writes_what_evaluate_reads(tmp_path: Path) -> None:
    bedroom = data_folder() / "house" / "bedroom"
    out = tmp_path / "gt.npz"
    done = run("ground-truth", bedroom, "-o", out, "--set", "capture.stop=20", "--set", "max_range=6")
    assert "wall" in done.stdout
    assert load_ground_truth(out).classes[1:3] == ("air conditioner", "bed")
    assert "exists" in refused("ground-truth", bedroom, "-o", out)
    assert "did you mean 'max_range'" in refused(
        "ground-truth", bedroom, "-o", tmp_path / "b.npz", "--set", "maxrange=6"
    )
    assert run("ground-truth", bedroom, "-o", tmp_path / "b.npz", "--protocol", "other", code=2).stderr
    classes = map_each_to_itself(load_ground_truth(out).classes)
    assert len(classes.classes) == 39
