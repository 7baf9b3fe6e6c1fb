"""Poses by structure from motion: from the rendered room, from scans that cannot be reconstructed, and from a model."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from photographs import Photographs, turning, walk

from freeocc3d.capture import Options as CaptureOptions
from freeocc3d.capture.cameras.lenses import Lens
from freeocc3d.core.errors import CaptureError, ConfigError, FreeOccError, TrackingError
from freeocc3d.core.progress import Progress
from freeocc3d.core.transforms import umeyama
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.tracking.sfm import colmap_reconstruction, mapping, structure_from_motion
from freeocc3d.tracking.sfm.reconstruction import Reconstruction
from freeocc3d.tracking.sfm.structure_from_motion import Recipe
from freeocc3d.tracking.trackers import colmap
from freeocc3d.tracking.trackers.colmap import ColmapTracker, Options


class Listener(Progress):
    """Remembers the progress that it gets, and raises Ctrl-C in a stage."""

    def __init__(self, stop_in: str = "") -> None:
        self.stop_in = stop_in
        self.stages: list[str] = []
        self.done = 0
        self.warnings: list[str] = []

    def stage(self, name: str, total: int | None = None) -> None:
        self.stages.append(name)

    def advance(self, done: int) -> None:
        self.done = done
        if self.stages[-1] == self.stop_in:
            raise KeyboardInterrupt

    def warn(self, text: str) -> None:
        self.warnings.append(text)


def reconstructed(
    images: Any, camera: Intrinsics, folder: Path, known: bool = True, progress: Progress | None = None, **recipe: Any
) -> Reconstruction:
    capture = Photographs(images, camera, known)
    return structure_from_motion.reconstruct_poses(
        capture, range(len(images)), folder, Recipe(**recipe), progress or Progress()
    )


def ate_cm(found: Reconstruction, true: np.ndarray) -> float:
    ours = found.T_world_cam[found.has_pose][:, :3, 3]
    theirs = true[found.has_pose][:, :3, 3]
    scale, R, t = umeyama(ours, theirs, with_scale=True)
    return float(100 * np.sqrt(((scale * ours @ R.T + t - theirs) ** 2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Reconstruction, Path]:
    """The walk, reconstructed from a focal length that is 4 % off."""
    images, _, camera = walk()
    folder = tmp_path_factory.mktemp("room")
    return reconstructed(images, replace(camera, fx=camera.fx * 1.04, fy=camera.fy * 1.04), folder), folder


def test_every_image_is_placed_and_the_focal_length_found(room: tuple[Reconstruction, Path]) -> None:
    found, _ = room
    _, true, camera = walk()
    assert found.has_pose.all()
    assert ate_cm(found, true) < 0.6
    assert found.lens.camera.fx == pytest.approx(camera.fx, rel=0.01)
    assert (found.lens.camera.cx, found.lens.camera.cy) == (camera.cx, camera.cy)
    assert not any(found.lens.distortion)
    assert np.median(found.depths()) == pytest.approx(2.0)
    assert found.warnings == ()


def test_points_lie_where_they_are_seen(room: tuple[Reconstruction, Path]) -> None:
    """In pixels of the image, by OpenCV: a convention of half a pixel would show."""
    found, folder = room
    with structure_from_motion.SfmDatabase(folder / "database.db") as database:
        pixels = [database.pixels(frame) for frame in range(3)]
    K = found.lens.camera.matrix
    for frame in range(3):
        T = np.linalg.inv(found.T_world_cam[frame])
        points = found.points[found.seen_point[found.seen_frame == frame]]
        projected, _ = cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, None)
        off = projected - pixels[frame][None]
        nearest = np.linalg.norm(off, axis=2).argmin(axis=1)
        shift = np.median(off[np.arange(len(off)), nearest], axis=0)
        assert np.abs(shift).max() < 0.15


def test_cameras_of_which_nothing_is_known_are_estimated(tmp_path: Path) -> None:
    images, true, camera = walk()
    lens = Lens(camera, (-0.12, 0.0, 0.0, 0.0))
    rays = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 1, 2)
    maps = cv2.undistortPoints(
        rays.astype(np.float32), camera.matrix, np.array(lens.distortion), None, None, camera.matrix
    ).reshape(camera.height, camera.width, 2)
    bent = [cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR) for image in images]
    guess = replace(camera, fx=1.25 * camera.fx, fy=1.25 * camera.fy)
    found = reconstructed(bent, guess, tmp_path, known=False)
    assert found.has_pose.all()
    assert ate_cm(found, true) < 1.0
    assert found.lens.camera.fx == pytest.approx(camera.fx, rel=0.03)
    assert found.lens.distortion[0] == pytest.approx(-0.12, abs=0.04)


def test_the_global_mapper_finds_the_same(tmp_path: Path) -> None:
    images, true, camera = walk()
    found = reconstructed(images, camera, tmp_path, mapping="global")
    assert found.has_pose.all()
    assert ate_cm(found, true) < 0.6


@pytest.mark.parametrize("stage", ["features", "matching", "mapping"])
def test_an_interrupted_run_goes_on(stage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images, _, camera = walk()
    monkeypatch.setattr(structure_from_motion, "_CHUNK", 6)
    with pytest.raises(KeyboardInterrupt):
        reconstructed(images, camera, tmp_path, progress=Listener(stop_in=stage))
    decoded = []

    class Counted(Photographs):
        def __getitem__(self, index: int) -> Any:
            decoded.append(index)
            return super().__getitem__(index)

    listener = Listener()
    found = structure_from_motion.reconstruct_poses(
        Counted(images, camera), range(len(images)), tmp_path, Recipe(), listener
    )
    assert found.has_pose.all()
    assert len(decoded) == (15 if stage == "features" else 0)
    again = Listener()
    structure_from_motion.reconstruct_poses(Counted(images, camera), range(len(images)), tmp_path, Recipe(), again)
    assert again.stages == []


def test_images_that_a_model_lacks_are_tried_again(room: tuple[Reconstruction, Path], tmp_path: Path) -> None:
    _, folder = room
    model = mapping.map_incrementally(folder / "database.db", tmp_path, False, lambda: None)[0]
    for frame_id in (3, 9):
        pycolmap.ObservationManager(model).deregister_frame(frame_id)
    assert model.num_reg_images() == 14
    assert mapping.continue_mapping(folder / "database.db", tmp_path, False, model).num_reg_images() == 16


def test_two_scenes_become_one_map_and_frames_apart(tmp_path: Path) -> None:
    images, _, camera = walk(45)
    found = reconstructed([*images[:12], *images[34:44]], camera, tmp_path)
    np.testing.assert_array_equal(found.has_pose, [True] * 12 + [False] * 10)
    np.testing.assert_array_equal(found.apart, [False] * 12 + [True] * 10)
    assert "2 models" in found.warnings[0].text


def test_scans_that_give_no_poses_are_distinguished(tmp_path: Path) -> None:
    images, _, camera = walk()
    rng = np.random.default_rng(0)
    still = [np.clip(images[0] + rng.normal(0, 3, images[0].shape), 0, 255).astype(np.uint8) for _ in range(8)]
    blurred = [cv2.GaussianBlur(image, (0, 0), 12) for image in images[:8]]
    turned, turned_camera = turning()
    for number, (taken, by, sentence) in enumerate(
        [
            (images[:3], camera, "3 usable images"),
            (still, camera, "stands still"),
            (blurred, camera, "blurred or show bare surfaces"),
            (turned, turned_camera, "only to turn"),
            ([images[0], *blurred[:3], *(np.rot90(walk(45)[0][k], 2) for k in (20, 34))], camera, "blurred|too little"),
        ]
    ):
        folder = tmp_path / str(number)
        folder.mkdir()
        with pytest.raises(TrackingError, match=sentence):
            reconstructed([np.ascontiguousarray(image) for image in taken], by, folder)


def tracked(found: Reconstruction, folder: Path, **options: Any) -> ColmapTracker:
    """A tracker of the walk whose reconstruction is saved already."""
    found.save(folder / "reconstruction.npz")
    images, _, camera = walk()
    tracker = colmap.load(Options(**options), Photographs(images, camera))
    assert tracker.offline
    tracker.prepare(folder, range(len(images)), Progress())
    return tracker


def two_meters_deep(tracker: ColmapTracker, index: int) -> Frame:
    """The frame as it is tracked, with the depth that a depth source may have given it."""
    frame = tracker.prepare_frame(tracker._capture[index])
    depth = 2.0 if np.isfinite(tracker.T_world_cam[index]).all() else 0.0
    return replace(frame, depth_m=np.full_like(frame.depth_m, depth))


def test_the_tracker_gives_poses_points_and_what_became_of_frames(
    room: tuple[Reconstruction, Path], tmp_path: Path
) -> None:
    found, _ = room
    T, apart, chosen = found.T_world_cam.copy(), found.apart.copy(), found.chosen.copy()
    T[10:] = np.nan
    apart[12:] = True
    chosen[3] = False
    altered = replace(found, T_world_cam=T, apart=apart, chosen=chosen)
    tracker = tracked(altered, tmp_path)
    for index in range(8):
        frame = two_meters_deep(tracker, index)
        assert frame.intrinsics == found.rectified.intrinsics
        tracker.track(frame)
    state = tracker.state()
    later = tracked(altered, tmp_path)
    later.restore(state, lambda index: two_meters_deep(later, index))
    for index in range(8, 16):
        later.track(two_meters_deep(later, index))
    trajectory = later.trajectory(later._capture.timestamps)
    assert trajectory.status[0] == "keyframe"
    assert trajectory.status[3] == "unused"
    assert trajectory.status[10:].tolist() == ["lost"] * 2 + ["apart"] * 4
    np.testing.assert_allclose(trajectory.T_world_cam[9], found.T_world_cam[9], atol=1e-6)
    posed = tracker.posed_points()
    np.testing.assert_array_equal(posed.T_world_cam, T)
    np.testing.assert_array_equal(posed.points[posed.seen_point], found.points[found.seen_point])


def test_frames_are_undistorted(room: tuple[Reconstruction, Path], tmp_path: Path) -> None:
    found, _ = room
    bent = replace(found, lens=Lens(found.lens.camera, (-0.2, 0.0, 0.0, 0.0)))
    tracker = tracked(bent, tmp_path)
    frame = tracker.prepare_frame(tracker._capture[0])
    assert frame.intrinsics == bent.rectified.intrinsics != bent.lens.camera
    np.testing.assert_array_equal(frame.color, bent.rectified.color(tracker._capture[0].color))


def test_options_are_checked() -> None:
    images, _, camera = walk()
    with pytest.raises(ConfigError, match="'order' must be auto, video or photos"):
        Options(order="film")
    with pytest.raises(ConfigError, match="needs the camera"):
        colmap.load(Options(intrinsics="fixed"), Photographs(images, camera, known=False))


def model_of(T_world_cam: np.ndarray, camera: pycolmap.Camera, names: list[str]) -> pycolmap.Reconstruction:
    """A COLMAP model with four points before each image."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for number, (name, T) in enumerate(zip(names, T_world_cam, strict=True), 1):
        local = np.array([(-0.5, 0, 4), (0.5, 0, 4), (0, 0.5, 4), (0, -0.5, 5)])
        image = pycolmap.Image(name, camera.img_from_cam(local), camera.camera_id, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(T)[:3]))
        for row, point in enumerate(local @ T[:3, :3].T + T[:3, 3]):
            model.add_point3D(point, pycolmap.Track([pycolmap.TrackElement(number, row)]))
    return model


@pytest.mark.parametrize("text", [True, False])
def test_an_existing_model_is_read(text: bool, tmp_path: Path) -> None:
    images, true, own = walk(4)
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 250.0, own.width, own.height)
    camera.params = [250.0, 251.0, 160.0, 120.0, 0.1, -0.02, 0.001, 0.002]
    model = model_of(true[[0, 1, 3]], camera, ["photo_000.jpg", "sub/photo_001.png", "photo_003.jpg"])
    (model.write_text if text else model.write_binary)(str(tmp_path))
    found = colmap_reconstruction.read_model(tmp_path, Photographs(images, own))
    np.testing.assert_array_equal(found.has_pose, [True, True, False, True])
    np.testing.assert_allclose(found.T_world_cam[3], true[3], atol=1e-6)
    assert found.lens.camera == Intrinsics(own.width, own.height, 250.0, 251.0, 159.5, 119.5)
    assert found.lens.distortion == (0.1, -0.02, 0.001, 0.002)
    np.testing.assert_allclose(np.sort(found.depths()), [4] * 9 + [5] * 3, atol=1e-5)


def test_a_model_of_a_fisheye_is_read_and_its_lens_kept(tmp_path: Path) -> None:
    images, true, own = walk(4)
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 250.0, own.width, own.height)
    camera.params = [250.0, 251.0, 160.0, 120.0, 0.02, -0.01, 0.0, 0.0]
    model_of(true, camera, [f"photo_00{i}.jpg" for i in range(4)]).write_binary(str(tmp_path))
    found = colmap_reconstruction.read_model(tmp_path, Photographs(images, own))
    assert found.lens == Lens(Intrinsics(own.width, own.height, 250.0, 251.0, 159.5, 119.5), (0.02, -0.01, 0, 0), True)
    found.save(tmp_path / "found.npz")
    assert Reconstruction.load(tmp_path / "found.npz").lens == found.lens


def test_models_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    images, true, own = walk(4)
    capture = Photographs(images, own)
    with pytest.raises(CaptureError, match="no COLMAP model"):
        colmap_reconstruction.read_model(tmp_path, capture)
    for name in ("cameras.bin", "images.bin"):
        (tmp_path / name).write_bytes(b"\x05")
    with pytest.raises(CaptureError, match="holds no readable COLMAP model"):
        colmap_reconstruction.read_model(tmp_path, capture)
    for number, (kind, size, name, sentence) in enumerate(
        [
            ("PINHOLE", (320, 240), "other_000.jpg", "belongs to a frame"),
            ("PINHOLE", (640, 480), "photo_000.jpg", "640 x 480"),
            ("FOV", (320, 240), "photo_000.jpg", "FOV, which is not supported"),
        ]
    ):
        folder = tmp_path / str(number)
        folder.mkdir()
        camera = pycolmap.Camera.create_from_model_name(1, kind, 250.0, *size)
        model_of(true[:1], camera, [name]).write_binary(str(folder))
        with pytest.raises(FreeOccError, match=sentence):
            colmap_reconstruction.read_model(folder, capture)


@pytest.mark.parametrize(("scale", "metric"), [(None, False), (2.0, True)])
def test_poses_are_metric_only_if_the_captures_scale_is_given(scale: float | None, metric: bool) -> None:
    class Scan:
        options = CaptureOptions(scale=scale)

        def __len__(self) -> int:
            return 3

    tracker = ColmapTracker(Options(), Scan())  # type: ignore[arg-type]
    assert (tracker.offline, tracker.metric) == (True, metric)
    assert np.isnan(tracker.poses_ahead()).all()
