"""Place recognition, loop closures, joint refinement, submaps: on rendered and real captures, and with wrong
closures."""

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from small_captures import data_folder

from freeocc3d.capture import open_capture
from freeocc3d.core.transforms import invert, measure_pose_difference, quats_to_rotations
from freeocc3d.tracking import pose_graph
from freeocc3d.tracking.pose_graph import Edge
from freeocc3d.tracking.rgbd import joint_refinement, loop_closures, place_recognition
from freeocc3d.tracking.rgbd.dense_alignment import ViewAlignment
from freeocc3d.tracking.rgbd.keyframe_registration import prepare_keyframe_view

FRAMES = range(0, 60, 4)


@pytest.fixture(scope="module")
def room():
    own = {"synthetic": {"frames": 60, "width": 320, "height": 240, "noise": True}}
    return open_capture("builtin:room", None, own)


@pytest.fixture(scope="module")
def views(room):
    return [prepare_keyframe_view(room[i]) for i in FRAMES]


@pytest.fixture(scope="module")
def true(room) -> list:
    first = invert(room.pose(0))
    return [first @ room.pose(i) for i in FRAMES]


def disturbed(poses, degrees: float, meters: float, seed: int = 0) -> list:
    """All but the first."""
    rng = np.random.default_rng(seed)
    out = [poses[0].copy()]
    for pose in poses[1:]:
        quat = np.array([1.0, *(0.5 * np.deg2rad(degrees) * rng.normal(size=3) / np.sqrt(3))])
        D = np.eye(4)
        D[:3, :3] = quats_to_rotations(quat / np.linalg.norm(quat))
        D[:3, 3] = meters * rng.normal(size=3) / np.sqrt(3)
        out.append(pose @ D)
    return out


def worst(poses, true) -> tuple[float, float]:
    off = np.array([measure_pose_difference(a, b) for a, b in zip(poses, true, strict=True)])
    return tuple(off.max(axis=0))


# Places


def test_similar_places_are_distinguished_from_others(views) -> None:
    described = [view.features.descriptors for view in views]
    vocabulary = place_recognition.Vocabulary(described)
    histograms = np.stack([vocabulary.histogram(d) for d in described])
    assert [int(h.sum()) for h in histograms] == [len(d) for d in described]
    alike = place_recognition.compare_histograms(histograms)
    np.testing.assert_allclose(np.diag(alike), 1.0, atol=1e-5)
    np.testing.assert_allclose(alike, alike.T, atol=1e-6)
    neighbors = np.diag(alike, 1)
    far = [alike[n, (n + len(views) // 2) % len(views)] for n in range(len(views))]
    assert np.median(neighbors) > np.median(far) + 0.1


def test_a_frame_without_features_is_like_none() -> None:
    rng = np.random.default_rng(0)
    vocabulary = place_recognition.Vocabulary([rng.integers(0, 256, (600, 32), dtype=np.uint8)])
    none = vocabulary.histogram(np.zeros((0, 32), np.uint8))
    assert none.sum() == 0
    assert (
        place_recognition.compare_histograms(
            np.stack((none, vocabulary.histogram(rng.integers(0, 256, (50, 32), dtype=np.uint8))))
        )[0, 1]
        == 0
    )


# Closures


def test_the_way_round_a_room_is_closed(views, true) -> None:
    count = len(views)
    found = loop_closures.find_closures(views, [0] * count, true)
    spans = {(edge.source, edge.target) for edge in found}
    assert any(a - b > count // 2 for a, b in spans), "the end sees the start again"
    for edge in found:
        meters, degrees = measure_pose_difference(invert(true[edge.target]) @ true[edge.source], edge.T_target_source)
        assert meters < 0.03
        assert degrees < 1.0
        assert edge.uncertain


def test_other_places_are_not_closed() -> None:
    house = data_folder() / "house"
    shown = [open_capture(house / name) for name in ("bedroom", "living")]
    keyframes = [prepare_keyframe_view(capture[i]) for capture in shown for i in range(0, 260, 20)]
    submap = [0] * 13 + [1] * 13
    poses = [capture.pose(i) for capture in shown for i in range(0, 260, 20)]
    found = loop_closures.find_closures(keyframes, submap, poses)
    assert all(submap[edge.source] == submap[edge.target] for edge in found)


# The joint refinement


def test_disturbed_poses_fall_into_place_together(views, true) -> None:
    start = disturbed(true, 1.0, 0.03)
    assert worst(start, true)[0] > 0.03
    refined = joint_refinement.refine_poses(views, start)
    meters, degrees = worst(refined, true)
    assert meters < 0.01
    assert degrees < 0.25
    np.testing.assert_allclose(refined[0], true[0], atol=1e-6)
    assert worst(start, true)[0] > 0.03, "the poses that were given are left alone"


def test_one_keyframe_needs_no_refinement(views, true) -> None:
    np.testing.assert_array_equal(joint_refinement.refine_poses(views[:1], true[:1])[0], true[0])


def test_each_keyframe_is_paired_with_a_bounded_number_of_others(views, true) -> None:
    pairs = joint_refinement.find_overlapping_pairs(views, true, neighbors=3, least=0.35)
    assert {(n, n - 1) for n in range(1, len(views))} <= set(pairs)
    counts = np.bincount([source for source, _ in pairs])
    assert counts.max() <= 4
    assert all(source > target for source, target in pairs)


# The pose graph


def motion(angle_deg: float, x: float) -> np.ndarray:
    T = np.eye(4)
    half = np.deg2rad(angle_deg) / 2
    T[:3, :3] = quats_to_rotations(np.array([np.cos(half), 0, np.sin(half), 0]))
    T[0, 3] = x
    return T


def ring(count: int = 10) -> tuple[list, list]:
    """Keyframes on a circle, and the odometry between neighbors, without error."""
    true = [motion(36 * k, 0.0) @ motion(0, 1.0) for k in range(count)]
    information = np.diag([1e4] * 6)
    edges = [Edge(k, k - 1, invert(true[k - 1]) @ true[k], information, uncertain=False) for k in range(1, count)]
    return true, edges


@pytest.mark.parametrize("wrong", [motion(80, 2.0), motion(15, 0.3), motion(0, -1.0)])
def test_one_wrong_closure_does_not_bend_a_map(wrong) -> None:
    true, edges = ring()
    information = np.diag([1e4] * 6)
    good = [Edge(k + 5, k, invert(true[k]) @ true[k + 5], information, uncertain=True) for k in range(4)]
    bad = Edge(8, 2, invert(true[2]) @ true[8] @ wrong, information, uncertain=True)
    placed = pose_graph.optimize_component(true, [*edges, *good, bad], range(10))
    assert worst(placed, [invert(true[0]) @ T for T in true] if np.allclose(placed[0], np.eye(4)) else true)[0] < 0.02


def test_two_submaps_are_tied_by_closures_that_agree() -> None:
    information = np.eye(6)
    submap = [0, 0, 0, 1, 1]
    poses = [motion(0, 0.1 * k) for k in range(3)] + [motion(0, 0.1 * k) for k in range(2)]
    one = Edge(3, 1, motion(0, 0.5), information, uncertain=True)  # submap 1 begins at x = 0.6
    other = Edge(2, 4, motion(0, -0.5), information, uncertain=True)  # says the same, from the other side
    wrong = Edge(4, 2, motion(60, 3.0), information, uncertain=True)
    within = Edge(2, 0, motion(0, 0.2), information, uncertain=True)
    certain = Edge(3, 2, motion(0, 1.0), information, uncertain=False)
    for edges, kept in (
        ([], []),
        ([one], []),
        ([one, wrong], []),
        ([one, wrong, other, within], [one, other, within]),
        ([certain, wrong], [certain]),
    ):
        found = pose_graph.drop_unsupported_closures(poses, submap, edges)
        assert found == kept
        tied = any(edge is not within for edge in kept)
        assert pose_graph.find_connected_components(submap, found) == (
            [[0, 1, 2, 3, 4]] if tied else [[0, 1, 2], [3, 4]]
        )


def test_a_tied_submap_is_laid_where_its_closures_say() -> None:
    true, edges = ring()
    information = np.diag([1e4] * 6)
    own = [edge for edge in edges if edge.source != 5]  # the path breaks between 4 and 5
    away = motion(120, 4.0)
    poses = true[:5] + [away @ T for T in true[5:]]
    ties = [Edge(k, k - 2, invert(true[k - 2]) @ true[k], information, uncertain=True) for k in (5, 6)]
    placed = pose_graph.optimize_component(poses, [*own, *ties], range(10))
    relative = [invert(placed[0]) @ T for T in placed]
    assert worst(relative, [invert(true[0]) @ T for T in true])[0] < 1e-3


# The borders of each test


def aligned(T: np.ndarray, **changes) -> ViewAlignment:
    """An alignment that passes every test, but for the changes."""
    good = {"determined": True, "overlap": 0.35, "inliers": 0.75, "correlation": 0.7}
    return ViewAlignment(T, np.diag(np.arange(1.0, 7.0)), **{**good, **changes})


class Rooms:
    """Keyframes on a line, of which 1 and 6 show the same place. ``wrong`` are pairs that do not align."""

    def __init__(self, monkeypatch, features=20, closing=(), off=0.0, wrong=(), drift=0.0, submap=(0,) * 8) -> None:
        self.true = [motion(20.0 * k, 0.2 * k) @ motion(0.0, 0.1) for k in range(8)]
        self.submap, self.asked = list(submap), []
        self.views = [SimpleNamespace(view=k) for k in range(8)]
        T = self.relative(6, 1)
        found = SimpleNamespace(
            by_features=T @ motion(0.0, off), agreeing=features, aligned=aligned(T, **dict(closing))
        )
        monkeypatch.setattr(loop_closures, "register_by_features", lambda source, target: found)

        def align(source, target, guess):
            self.asked.append((source, target))
            np.testing.assert_allclose(guess, self.relative(source, target), atol=1e-9)
            good = (source, target) not in wrong
            return aligned(guess @ motion(0.0, drift), overlap=0.9 if good else 0.1)

        monkeypatch.setattr(loop_closures.dense_alignment, "align_views", align)

    def relative(self, source: int, target: int) -> np.ndarray:
        return invert(self.true[target]) @ self.true[source]

    def verified(self) -> Edge | None:
        return loop_closures.verify_closure(self.views, self.submap, self.true, 6, 1)  # type: ignore[arg-type]


def test_a_closure_is_the_aligned_pose_and_a_neighbor_confirms_it(monkeypatch) -> None:
    rooms = Rooms(monkeypatch)
    edge = rooms.verified()
    assert edge is not None
    assert (edge.source, edge.target, edge.uncertain) == (6, 1, True)
    np.testing.assert_array_equal(edge.T_target_source, rooms.relative(6, 1))
    np.testing.assert_array_equal(np.diag(edge.information), np.arange(1, 7))
    assert rooms.asked == [(5, 1)], "one neighbor is enough"


@pytest.mark.parametrize(
    ("changes", "closed"),
    [
        ({"features": 19}, False),
        ({"closing": {"determined": False}}, False),
        ({"closing": {"overlap": 0.34}}, False),
        ({"closing": {"inliers": 0.74}}, False),
        ({"closing": {"correlation": 0.69}}, False),
        ({"closing": {"correlation": float("nan")}}, False),
        ({"off": 0.099}, True),
        ({"off": 0.101}, False),
        ({"drift": 0.099}, True),
        ({"drift": 0.101}, False),
        ({"wrong": [(5, 1), (7, 1), (6, 0)]}, True),
        ({"wrong": [(5, 1), (7, 1), (6, 0), (6, 2)]}, False),
        ({"submap": (0, 0, 0, 0, 1, 1, 1, 1), "wrong": [(5, 1), (7, 1), (6, 0)]}, True),
        ({"submap": (0, 1, 2, 3, 4, 5, 6, 7)}, False),  # no keyframe has a neighbor
        ({"submap": (0, 0, 1, 1, 1, 2, 3, 4), "wrong": [(6, 0)]}, False),
    ],
)
def test_each_test_of_a_closure_has_its_border(monkeypatch, changes, closed) -> None:
    assert (Rooms(monkeypatch, **changes).verified() is not None) == closed


def test_compared_are_the_most_alike_that_are_not_close_on_the_path(monkeypatch) -> None:
    rng = np.random.default_rng(0)
    described = [rng.integers(0, 256, (30, 32), dtype=np.uint8) for _ in range(12)]
    keyframes = [SimpleNamespace(features=SimpleNamespace(descriptors=one)) for one in described]
    alike = np.full((12, 12), 0.1)
    for a, b, value in (
        (0, 3, 0.9), (0, 4, 0.15), (0, 5, 0.149), (2, 9, 0.5), (6, 8, 0.8), (7, 9, 0.8),
        (11, 1, 0.3), (11, 2, 0.31), (11, 3, 0.32), (11, 4, 0.33), (11, 5, 0.34),
    ):  # fmt: skip
        alike[a, b] = alike[b, a] = value
    alike[1, 6:10] = alike[6:10, 1] = 0.4
    monkeypatch.setattr(loop_closures, "compare_histograms", lambda histograms: alike)
    submap = [0] * 8 + [1] * 4
    with ThreadPoolExecutor(1) as pool:
        found = loop_closures._candidates(keyframes, submap, pool)  # type: ignore[arg-type]
        assert loop_closures._candidates(keyframes[:1], [0], pool) == []  # type: ignore[arg-type]
        few = [SimpleNamespace(features=SimpleNamespace(descriptors=one[:20])) for one in (described[0], described[4])]
        monkeypatch.setattr(loop_closures, "compare_histograms", lambda histograms: np.ones((2, 2)))
        assert loop_closures._candidates(few, [0, 1], pool) == [(1, 0)]  # type: ignore[arg-type]
        few[0].features.descriptors = described[0][:19]
        assert loop_closures._candidates(few, [0, 1], pool) == [], "two poses need forty features"  # type: ignore[arg-type]
    near = {(3, 0), (8, 6), (9, 7)}  # the first is too close on the path, the others are of two submaps
    assert set(found) & near == {(8, 6), (9, 7)}
    assert {(4, 0), (9, 2)} <= set(found)
    assert (5, 0) not in found
    assert {(11, n) for n in (2, 3, 4, 5)} <= set(found)
    assert (11, 1) not in found, "four are more alike to either"
    assert found == sorted(found)
    assert all(later > earlier for later, earlier in found)


@pytest.mark.parametrize(
    ("angle", "x", "agrees"), [(9.9, 0.0, True), (10.1, 0.0, False), (0, 0.29, True), (0, 0.31, False)]
)
def test_two_closures_of_submaps_agree_up_to_the_drift_of_a_path(angle: float, x: float, agrees: bool) -> None:
    poses, submap = [motion(10.0 * k, 0.5 * k) for k in range(4)], [0, 0, 1, 1]
    T = motion(35, 1.0)  # of submap 1 in submap 0
    first = Edge(2, 0, invert(poses[0]) @ T @ poses[2], np.eye(6), uncertain=True)
    second = Edge(1, 3, invert(poses[3]) @ invert(T @ motion(angle, x)) @ poses[1], np.eye(6), uncertain=True)
    assert pose_graph.drop_unsupported_closures(poses, submap, [first, second]) == ([first, second] if agrees else [])


def test_edges_come_back_from_arrays() -> None:
    edges = [Edge(k + 3, k, motion(10 * k, k), np.diag(np.arange(6.0) + k), uncertain=k == 1) for k in range(3)]
    for edge, again in zip(edges, pose_graph.edges_from_arrays(pose_graph.edges_to_arrays(edges)), strict=True):
        assert (again.source, again.target, again.uncertain) == (edge.source, edge.target, edge.uncertain)
        np.testing.assert_array_equal(again.T_target_source, edge.T_target_source)
        np.testing.assert_array_equal(again.information, edge.information)
    assert pose_graph.edges_from_arrays(pose_graph.edges_to_arrays([])) == []
