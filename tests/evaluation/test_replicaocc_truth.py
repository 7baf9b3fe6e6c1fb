"""The builder of ground truths: an exact analytic scene, a plain reference, and the shipped truths."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA
from small_captures import data_folder, truncate, write_replica, write_seven_scenes

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Capture, Options
from freeocc3d.core.errors import ConfigError, FreeOccError
from freeocc3d.core.types import Frame
from freeocc3d.evaluation import replicaocc_truth
from freeocc3d.evaluation.ground_truth import load_ground_truth
from freeocc3d.evaluation.true_occupancy import GroundTruth


class Corner(Capture):
    """Cameras that look along +z at a wall at z = 2.03, left of x = 0 of class 1 and right of it of class 2; a post of
    class 3, 10 cm wide, stands before it at z = 1.23. Depth and classes are exact."""

    format = layout = "corner"

    def __init__(self, places: list[float], classes: tuple[str, ...] = ("nothing", "wall", "door", "post")):
        super().__init__(Path("corner"), Options())
        self.places = places
        self.classes = classes
        self.timestamps = np.arange(len(places), dtype=float)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False

    def _rendered(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        u = np.arange(CAMERA.width)
        ray = (u - CAMERA.cx) / CAMERA.fx
        post = np.abs(self.places[index] + 1.23 * ray - 0.3) < 0.05
        wall = np.where(self.places[index] + 2.03 * ray < 0, 1, 2)
        shape = (CAMERA.height, CAMERA.width)
        depth = np.broadcast_to(np.where(post, 1.23, 2.03).astype(np.float32), shape)
        return depth.copy(), np.broadcast_to(np.where(post, 3, wall).astype(np.uint8), shape).copy()

    def __getitem__(self, index: int) -> Frame:
        depth = self._rendered(index)[0]
        return Frame(index, float(index), np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA)

    def pose(self, index: int) -> NDArray[np.float64] | None:
        T = np.eye(4)
        T[0, 3] = self.places[index]
        return T

    def labels(self, index: int) -> NDArray[np.uint8] | None:
        return self._rendered(index)[1]


def plain(capture: Corner, options: replicaocc_truth.Options) -> GroundTruth:
    """The protocol written out, one pixel and one voxel after the other."""
    size, offset = options.voxel_size, np.array(options.lattice_offset)
    votes: dict[tuple[int, ...], list[int]] = {}
    for index in range(len(capture)):
        depth, labels = capture._rendered(index)
        for v in range(0, CAMERA.height, options.pixel_stride):
            for u in range(0, CAMERA.width, options.pixel_stride):
                z = float(depth[v, u])
                point = (z * (u - CAMERA.cx) / CAMERA.fx + capture.places[index], z * (v - CAMERA.cy) / CAMERA.fy, z)
                voxel = tuple(int(i) for i in np.floor((np.array(point) - offset) / size))
                votes.setdefault(voxel, []).append(int(labels[v, u]))
    low = np.array(list(votes)).min(axis=0)
    shape = np.array(list(votes)).max(axis=0) - low + 1
    out = np.full(shape, 255, np.uint8)
    for cell in np.ndindex(*shape):
        center = offset + (np.array(cell) + low + 0.5) * size
        for index in range(0, len(capture), options.frame_stride):
            x, y, z = center - (capture.places[index], 0, 0)
            if z <= 0:
                continue
            u, v = (
                int(np.floor(CAMERA.fx * x / z + CAMERA.cx + 0.5)),
                int(np.floor(CAMERA.fy * y / z + CAMERA.cy + 0.5)),
            )
            inside = 0 <= u < CAMERA.width and 0 <= v < CAMERA.height
            if inside and z <= capture._rendered(index)[0][v, u] + options.tolerance * size:
                own = votes.get(tuple(int(i) for i in np.array(cell) + low), [])
                out[cell] = np.bincount(own).argmax() if own else 0
                break
    return GroundTruth(out, offset + low * size, size, ("free", *capture.classes[1:]))


def test_an_analytic_scene_is_matched_exactly() -> None:
    """Cameras along x from -0.5 to 0.5: the wall's voxels lie at z index 25 (2.00 … 2.08), the post's at 15 (1.20 …
    1.28) from x = 0.25 to 0.35; whoever looks past the post sees the space behind it."""
    capture = Corner([-0.5, 0.0, 0.5])
    truth = replicaocc_truth.build_truth_from_capture(capture, replicaocc_truth.Options(pixel_stride=1, frame_stride=1))
    low = np.rint(truth.origin / 0.08).astype(int)
    assert low[2] == 15
    assert truth.shape[2] == 11
    wall = truth.labels[:, :, 10]
    x_of = truth.origin[0] + (np.arange(truth.shape[0]) + 0.5) * 0.08
    assert set(np.unique(wall[(x_of < 0)])) == {1}
    assert set(np.unique(wall[(x_of > 0.04)])) == {2}
    assert set(np.unique(truth.labels[:, :, 1:10])) <= {0, 255}
    post = truth.labels[:, :, 0]
    standing = (x_of + 0.04 > 0.25) & (x_of - 0.04 < 0.35)
    middle = truth.shape[1] // 2
    assert (post[standing][:, middle] == 3).all()
    assert not (post[~standing] == 3).any()
    # Nothing is seen right behind the post, at its foot and for a voxel's tolerance; from the side it is.
    assert (truth.labels[:, middle, 5] == 0).sum() > 10


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"pixel_stride": 3, "frame_stride": 1},
        {"voxel_size": 0.11, "lattice_offset": (0.013, -0.02, 0.05)},
        {"tolerance": 0.25, "frame_stride": 3},
    ],
)
def test_the_builder_agrees_with_the_protocol_written_out(changes: dict) -> None:
    capture, options = Corner([-0.21, 0.02, 0.13, 0.3]), replicaocc_truth.Options(**changes)
    built, expected = replicaocc_truth.build_truth_from_capture(capture, options), plain(capture, options)
    np.testing.assert_allclose(built.origin, expected.origin)
    np.testing.assert_array_equal(built.labels, expected.labels)
    assert built.classes == ("free", "wall", "door", "post")


def test_what_a_frame_observes_is_that_of_a_plain_computation() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 4.0, (CAMERA.height, CAMERA.width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    frame = Frame(0, 0.0, np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA)
    options = replicaocc_truth.Options(voxel_size=0.2, max_range=3.0)
    T_world_cam, origin, shape = np.eye(4), np.array((-2.0, -1.5, -0.5)), (20, 15, 20)
    T_world_cam[:3, :3] = cv2.Rodrigues(np.array((0.2, -0.4, 0.1)))[0]
    T_world_cam[:3, 3] = (0.1, -0.2, 0.3)
    known = rng.random(shape) < 0.1
    seen = known.copy()
    replicaocc_truth.mark_observed(seen, frame, T_world_cam, origin, options)

    centers = origin + (np.stack(np.indices(shape), axis=-1) + 0.5) * options.voxel_size
    x, y, z = np.moveaxis((centers - T_world_cam[:3, 3]) @ T_world_cam[:3, :3], -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.floor(CAMERA.fx * x / z + CAMERA.cx + 0.5).astype(int)
        v = np.floor(CAMERA.fy * y / z + CAMERA.cy + 0.5).astype(int)
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
    measured = depth[np.where(inside, v, 0), np.where(inside, u, 0)]
    usable = inside & (measured > 0) & (measured <= options.max_range)
    expected = known | (usable & (z <= measured + options.tolerance * options.voxel_size))
    np.testing.assert_array_equal(seen, expected)
    assert 0.02 < (expected & ~known).mean() < 0.9


def test_within_fills_the_neighbors_of_what_a_point_lies_in() -> None:
    capture = Corner([0.0])
    inside, within = (
        replicaocc_truth.build_truth_from_capture(
            capture, replicaocc_truth.Options(pixel_stride=1, frame_stride=1, dilation=50, fill=fill)
        )
        for fill in ("inside", "within")
    )
    occupied, filled = ((t.labels > 0) & (t.labels < 255) for t in (inside, within))
    padded = np.pad(occupied, 1)
    grown = occupied.copy()
    for axis in range(3):
        for shift in (-1, 1):
            grown |= np.roll(padded, shift, axis)[1:-1, 1:-1, 1:-1]
    assert (within.labels < 255).all()
    np.testing.assert_array_equal(filled, grown)
    np.testing.assert_array_equal(within.labels[occupied], inside.labels[occupied])


def test_dilation_and_range_change_only_what_is_known() -> None:
    capture = Corner([-0.2, 0.2])
    usual = replicaocc_truth.build_truth_from_capture(capture, replicaocc_truth.Options(frame_stride=1))
    grown = replicaocc_truth.build_truth_from_capture(capture, replicaocc_truth.Options(frame_stride=1, dilation=2))
    known = usual.labels != 255
    assert ((grown.labels != 255) & ~known).any()
    np.testing.assert_array_equal(grown.labels[known], usual.labels[known])
    near = replicaocc_truth.build_truth_from_capture(capture, replicaocc_truth.Options(frame_stride=1, max_range=1.5))
    assert set(np.unique(near.labels)) <= {0, 3, 255}
    with pytest.raises(FreeOccError, match=r"measured nothing within 0\.5 m"):
        replicaocc_truth.build_truth_from_capture(capture, replicaocc_truth.Options(max_range=0.5))


def test_few_points_are_left_out_if_asked() -> None:
    capture = Corner([0.0])
    usual = replicaocc_truth.build_truth_from_capture(capture, replicaocc_truth.Options(frame_stride=1))
    sure = replicaocc_truth.build_truth_from_capture(capture, replicaocc_truth.Options(frame_stride=1, min_points=2))
    counts = [int(((t.labels > 0) & (t.labels < 255)).sum()) for t in (usual, sure)]
    assert 0 < counts[1] < counts[0]


def test_votes_do_not_depend_on_the_order_of_frames_or_on_merging(monkeypatch: pytest.MonkeyPatch) -> None:
    capture, options = Corner([-0.3, -0.1, 0.1, 0.3]), replicaocc_truth.Options(pixel_stride=1)
    results = []
    for order, rows in (([0, 1, 2, 3], 10**6), ([3, 1, 0, 2], 10)):
        monkeypatch.setattr(replicaocc_truth, "_ROWS_BEFORE_MERGE", rows)
        votes = replicaocc_truth.Votes(options, 4)
        for index in order:
            frame, T = capture[index], capture.pose(index)
            assert T is not None
            votes.add(frame, T, capture.labels(index))
        results.append(votes.labeled())
    np.testing.assert_array_equal(results[0][0], results[1][0])
    np.testing.assert_array_equal(results[0][1], results[1][1])


def test_a_capture_without_class_images_gives_geometry(tmp_path: Path) -> None:
    truth = replicaocc_truth.build_truth(write_seven_scenes(tmp_path / "scan", 4), ["pixel_stride=1"])
    assert truth.classes == ("free", "occupied")
    assert set(np.unique(truth.labels)) == {0, 1, 255}
    classed = replicaocc_truth.build_truth(write_replica(tmp_path / "classed", 4, classes=True), ["pixel_stride=1"])
    assert classed.classes == ("free", "sofa", "lamp")
    assert {1, 2} <= set(np.unique(classed.labels))


def test_what_cannot_be_built_is_reported_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bare = write_seven_scenes(tmp_path / "bare", 3, poses=False)
    with pytest.raises(FreeOccError, match="has no poses"):
        replicaocc_truth.build_truth(bare)
    scan = write_seven_scenes(tmp_path / "scan", 3)
    with pytest.raises(ConfigError, match="did you mean 'pixel_stride'"):
        replicaocc_truth.build_truth(scan, ["pixelstride=3"])
    with pytest.raises(ConfigError, match="inside or within"):
        replicaocc_truth.build_truth(scan, ["fill=near"])
    with pytest.raises(ConfigError, match="name=value"):
        replicaocc_truth.build_truth(scan, ["fill"])
    with monkeypatch.context() as patched:
        patched.setattr(replicaocc_truth, "_LARGEST_GRID", 10)
        with pytest.raises(FreeOccError, match="too many for memory"):
            replicaocc_truth.build_truth(scan)
    truncate(scan / "frame-000001.depth.png")
    assert replicaocc_truth.build_truth(scan, ["pixel_stride=1"]).labels.size  # the other frames are used


def agreement(name: str, *overrides: str) -> tuple[float, float]:
    """IoU of a truth built from sensor depth with the shipped one inside the latter's mask, and the share of what both
    call occupied that has the same class."""
    folder = data_folder() / name
    shipped = load_ground_truth(folder / "ground_truth.npz")
    built = replicaocc_truth.build_truth(folder, ["max_range=6", "lattice_offset=[0, 0, -0.04]", *overrides])
    low = np.rint((built.origin - shipped.origin) / 0.08).astype(int)
    np.testing.assert_allclose(shipped.origin + low * 0.08, built.origin, atol=1e-6)  # the same lattice
    own = np.full(shipped.shape, 255, np.uint8)
    cells = np.argwhere(built.labels != 255)
    kept = cells[((cells + low >= 0) & (cells + low < shipped.shape)).all(axis=1)]
    own[tuple((kept + low).T)] = built.labels[tuple(kept.T)]
    occupied, true = (own > 0) & (own < 255), (shipped.labels > 0) & (shipped.labels < 255)
    known = shipped.labels != 255
    both = occupied & true
    return float(both.sum() / ((occupied | true) & known).sum()), float((own == shipped.labels)[both].mean())


def test_from_sensor_depth_it_comes_near_the_shipped_truth() -> None:
    exact_iou, exact_class = agreement("house/bedroom", "capture.stride=3")
    assert exact_iou > 0.7  # noise scatters single points into the voxels beside a wall
    assert exact_class > 0.99
    surer, _ = agreement("house/bedroom", "capture.stride=3", "min_points=10")
    assert surer > 0.78


def test_the_room_built_from_its_frames_agrees_with_its_exact_truth() -> None:
    capture = open_capture("builtin:room", Options(stride=4), {"synthetic": {"width": 320, "height": 240}})
    exact = capture.ground_truth()
    offset = tuple(float(c) for c in np.mod(exact["origin"], 0.08))
    built = replicaocc_truth.build_truth_from_capture(
        capture, replicaocc_truth.Options(pixel_stride=1, lattice_offset=offset)
    )
    low = np.rint((built.origin - exact["origin"]) / 0.08).astype(int)
    np.testing.assert_allclose(exact["origin"] + low * 0.08, built.origin, atol=1e-6)
    common = tuple(slice(max(int(o), 0), int(o) + n) for o, n in zip(low, built.shape, strict=True))
    cut = tuple(slice(max(-int(o), 0), None) for o in low)
    theirs = exact["labels"][common]
    own = built.labels[cut][tuple(slice(0, n) for n in theirs.shape)]
    theirs = theirs[tuple(slice(0, n) for n in own.shape)]
    known = (own != 255) & (theirs != 255)
    occupied, true = (own > 0)[known], (theirs > 0)[known]
    assert (occupied & true).sum() / (occupied | true).sum() > 0.8
