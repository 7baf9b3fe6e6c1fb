"""Multi-view stereo on the built-in room at its true poses."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from depth_networks import write_network

from freeocc3d.capture import open_capture
from freeocc3d.capture.base import Capture, Options
from freeocc3d.core.errors import ConfigError, FrameError, MapError, TrackingError
from freeocc3d.core.progress import Progress
from freeocc3d.core.transforms import invert, project, transform
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.depth import multi_view_stereo
from freeocc3d.depth.cross_view_check import DepthImage
from freeocc3d.depth.photo_consistency import StereoView
from freeocc3d.depth.sparse_points import triangulate
from freeocc3d.depth.stereo_source import StereoSource
from freeocc3d.tracking.trackers import known

FRAMES = range(12)


class Color(Capture):
    """The room in frames of 320 x 240 pixels, part of a walk, without depth."""

    format, layout, has_depth = "color", "", False

    def __init__(self) -> None:
        self.room = open_capture("builtin:room", Options(), {"synthetic": {"frames": 64, "width": 320, "height": 240}})
        super().__init__(self.room.path, Options())
        self.timestamps = self.room.timestamps
        self.decoded = 0
        self.broken: set[int] = set()

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False

    def __getitem__(self, index: int) -> Frame:
        if index in self.broken:
            raise FrameError(f"frame {index}")
        self.decoded += 1
        frame = self.room[index]
        return replace(frame, depth_m=np.zeros_like(frame.depth_m))

    def pose(self, index: int):
        return self.room.pose(index)


SMALL = {"size": 128}


def _source(capture: Capture, folder: Path, frames=FRAMES, change: Callable = lambda T: T) -> StereoSource:
    tracker = known.load(known.Options(), capture)
    tracker.T_world_cam = change(tracker.T_world_cam)
    source = StereoSource(capture, multi_view_stereo.Options(**SMALL))
    assert source.offline
    source.prepare(tracker, folder, frames, Progress())
    return source


@pytest.fixture(scope="module")
def computed(tmp_path_factory):
    capture, folder = Color(), tmp_path_factory.mktemp("stereo")
    return capture, folder, _source(capture, folder)


@pytest.fixture(scope="module")
def scan():
    capture = Color()
    return triangulate(capture, known.load(known.Options(), capture).T_world_cam, FRAMES, Progress())


def _again(capture: Capture, scan, folder: Path, without: str = "", **options) -> multi_view_stereo.StereoDepth:
    """Computes what a folder lacks, after the files of a pattern were removed from it."""
    for path in folder.glob(without) if without else ():
        path.unlink()
    depth = multi_view_stereo.StereoDepth(folder, multi_view_stereo.Options(**SMALL, **options))
    depth.compute(capture, scan, FRAMES, Progress())
    return depth


def _against_truth(capture, source):
    """Relative errors where there is a depth, the share of pixels that have one, errors in standard deviations."""
    errors, sure, true = [], [], 0
    for index in FRAMES:
        truth = capture.room[index].depth_m
        found = source._depth.depth(index)
        true += np.count_nonzero(truth)
        if found is not None:
            both = (truth > 0) & (found[0] > 0)
            errors.append(np.abs(found[0] - truth)[both] / truth[both])
            sure.append(np.abs(found[0] - truth)[both] / found[1][both])
    return np.concatenate(errors), sum(map(len, errors)) / true, np.concatenate(sure)


def test_the_room_is_measured(computed) -> None:
    capture, _, source = computed
    errors, share, in_sigmas = _against_truth(capture, source)
    assert np.median(errors) < 0.01
    assert share > 0.4
    assert 0.1 < np.median(in_sigmas) < 1.5
    frame = source.complete(capture[10])
    assert frame.depth_m.shape == frame.color.shape[:2]
    assert frame.depth_m.dtype == np.float32
    assert frame.depth_sigma_m.dtype == np.float32
    assert (frame.depth_sigma_m[frame.depth_m > 0] > 0).all()
    assert known.load(known.Options(), capture).track(frame).status == "keyframe"


def test_what_was_computed_is_taken_up_again(computed) -> None:
    capture, folder, _ = computed
    files = {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in (folder / "depth").iterdir()}
    for name in ("layout.npz", "000010.depth.npz"):
        (folder / "depth" / name).unlink()
    _source(capture, folder)
    made_again = {name for name in files if (folder / "depth" / name).stat().st_mtime_ns != files[name][0]}
    assert made_again == {"surface.npz", "layout.npz", "000010.depth.npz"}
    assert {path.name: path.read_bytes() for path in (folder / "depth").iterdir()} == {
        name: content for name, (_, content) in files.items()
    }


def test_a_damaged_surface_is_reported(computed, scan, tmp_path: Path) -> None:
    capture, folder, _ = computed
    copied = shutil.copytree(folder / "depth", tmp_path / "depth")
    path = copied / "surface.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **{**arrays, "triangles": arrays["triangles"] + len(arrays["vertices"])})
    with pytest.raises(MapError, match=r"surface.npz is damaged"):
        _again(capture, scan, copied)
    np.savez(path, **{**arrays, "sigma_m": arrays["sigma_m"][:-1]})
    with pytest.raises(MapError, match=r"surface.npz is damaged: its arrays"):
        _again(capture, scan, copied)
    path.write_bytes(b"")
    with pytest.raises(MapError, match=r"surface.npz is damaged"):
        _again(capture, scan, copied)


def test_a_damaged_layout_is_reported(computed, scan, tmp_path: Path) -> None:
    capture, folder, _ = computed
    copied = shutil.copytree(folder / "depth", tmp_path / "depth")
    path = copied / "layout.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    assert len(arrays["offsets"]) > 0
    for name, damaged in (("support", arrays["support"][:-1]), ("offsets", arrays["offsets"][:-1])):
        np.savez(path, **{**arrays, name: damaged})
        with pytest.raises(MapError, match=r"layout.npz is damaged: it holds"):
            _again(capture, scan, copied)
    np.savez(path, **{name: array for name, array in arrays.items() if name != "outermost"})
    with pytest.raises(MapError, match=r"layout.npz is damaged"):
        _again(capture, scan, copied)


def test_images_that_show_nothing_are_reported(scan, tmp_path: Path) -> None:
    class Blank(Color):
        def __getitem__(self, index: int) -> Frame:
            frame = super().__getitem__(index)
            return replace(frame, color=np.full_like(frame.color, 128))

    depth = multi_view_stereo.StereoDepth(tmp_path, multi_view_stereo.Options(size=64))
    with pytest.raises(TrackingError, match="bare surfaces"):
        depth.compute(Blank(), scan, range(6), Progress())


def test_points_are_where_surfaces_are(computed, scan) -> None:
    capture, _, _ = computed
    assert len(scan.points) > 500
    frame = capture.room[10]
    seen = scan.points[scan.seen_point[scan.seen_frame == 10]]
    cam = transform(invert(capture.pose(10)), seen)
    K = frame.intrinsics
    pixels, _ = project(cam.astype(np.float64), K)
    u, v = np.rint(pixels).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < K.width) & (v < K.height)
    depth = frame.depth_m[v[inside], u[inside]]
    off = np.abs(cam[inside, 2] - depth)[depth > 0] / depth[depth > 0]
    assert np.median(off) < 0.05


def test_broken_frames_are_done_without(computed, scan, tmp_path: Path) -> None:
    capture = Color()
    capture.broken = {5}
    copied = shutil.copytree(computed[1] / "depth", tmp_path / "depth")
    depth = _again(capture, scan, copied, without="00000[45].*.npz")
    assert depth.depth(5) is None
    assert depth.depth(4) is not None


def test_a_network_fills_what_stereo_leaves_empty(computed, scan, tmp_path: Path) -> None:
    network = write_network(tmp_path / "n.onnx")
    copied = shutil.copytree(computed[1] / "depth", tmp_path / "depth")
    for path in copied.glob("*.depth.npz"):
        path.unlink()
    fused = _again(Color(), scan, copied, without="*.view.npz", network=str(network))
    counts = [[np.count_nonzero(depth.depth(i)[0]) for i in range(1, 5)] for depth in (computed[2]._depth, fused)]
    assert (np.array(counts[1]) >= counts[0]).all()


def test_a_camera_that_only_turns_measures_nothing(tmp_path: Path) -> None:
    def turned(T):
        T = T.copy()
        T[:, :3, 3] = 0.0
        return T

    with pytest.raises(TrackingError, match="sideways"):
        _source(Color(), tmp_path, range(8), turned)


@pytest.mark.parametrize("given", [{"size": 10}, {"neighbors": 0}, {"agreeing": 0}])
def test_options_out_of_range(given) -> None:
    with pytest.raises(ConfigError):
        multi_view_stereo.Options(**given)


@pytest.mark.parametrize(
    ("size", "given", "made"),
    [
        (480, (640, 480), (480, 360)),
        (480, (480, 640), (360, 480)),
        (480, (321, 201), (320, 200)),
        (33, (66, 44), (32, 22)),
    ],
)
def test_images_are_shrunk_to_even_sides_and_never_enlarged(size: int, given, made) -> None:
    width, height = given
    view = StereoView(np.zeros((height, width, 3), np.uint8), Intrinsics(width, height, 1.0, 1.0, 0.0, 0.0), np.eye(4))
    small = multi_view_stereo._shrunk(view, size)
    assert (small.intrinsics.width, small.intrinsics.height) == small.color.shape[::-1] == made


def test_depth_is_interpolated_on_a_surface_and_never_across_its_edge() -> None:
    inverse = np.full((4, 8), 0.5, np.float32)
    inverse[:, 2:] = 0.505  # a percent: one surface
    inverse[:, 4:] = 0.57  # twelve percent: another
    inverse[:, 6:] = 0
    sigma = np.tile(np.float32([1, 2, 3, 4, 5, 6, 7, 8]) * 0.001, (4, 1))
    image = DepthImage(inverse, sigma, Intrinsics(8, 4, 1.0, 1.0, 0.0, 0.0), np.eye(4))
    between, spread = multi_view_stereo._enlarged(image, 16, 8)
    assert between.shape == spread.shape == (8, 16)
    np.testing.assert_allclose(
        between[3], [0.5] * 3 + [0.50125, 0.50375] + [0.505] * 3 + [0.57] * 4 + [0] * 4, atol=1e-6
    )
    np.testing.assert_allclose(spread[3], np.repeat(sigma[0], 2))
    depth, deviation = multi_view_stereo._meters(between, spread)
    np.testing.assert_allclose(depth[3, [0, 8, 15]], (2.0, 1 / 0.57, 0.0), rtol=1e-6)
    np.testing.assert_allclose(deviation[3, [0, 8, 15]], (0.004, 0.005 / 0.57**2, 0.0), rtol=1e-6)
