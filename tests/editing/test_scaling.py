"""The scale of maps: a copy of the built-in room at half its size, without a unit."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import yaml
from command_line import refused, run
from manifests import tiny_manifest
from posed_captures import write_colmap, write_nerfstudio

from freeocc3d.capture import open_capture
from freeocc3d.core.errors import FreeOccError, MapError
from freeocc3d.core.transforms import is_rigid, transform
from freeocc3d.core.tum_files import write_tum
from freeocc3d.core.types import Intrinsics, Trajectory
from freeocc3d.core.warnings import Notice, read_notices
from freeocc3d.editing import scaling
from freeocc3d.query.scan_map import Map, load_map
from freeocc3d.storage import map_files
from freeocc3d.storage.manifest import MapScale, Refined, Upright, matrix
from freeocc3d.tracking.trackers import file, known
from freeocc3d.viewer import map_pictures

ANOTHER = Notice("frames-lost", "another")


@pytest.fixture(scope="module")
def half(room: Map, tmp_path_factory) -> Map:
    """Half as large, in no unit."""
    made = scaling.scale_map(room, 0.5, "given", tmp_path_factory.mktemp("scale") / "half")
    manifest = yaml.safe_load((made.path / map_files.MANIFEST).read_text())
    manifest["scale"] = {"metric": False, "by": "none", "factor": 1.0}
    report = {**made.report, "warnings": [Notice("scale-unknown", "").to_dict(), ANOTHER.to_dict()]}
    (made.path / map_files.REPORT).write_text(json.dumps(report))
    manifest["files"][map_files.REPORT] = (made.path / map_files.REPORT).stat().st_size
    del manifest["checksums"]
    (made.path / map_files.MANIFEST).write_text(yaml.safe_dump(manifest))
    return load_map(made.path)


def test_maps_whose_warnings_have_no_codes_said_last_that_their_scale_is_unknown() -> None:
    older = SimpleNamespace(metric=False, report={"warnings": ["frames were lost", "the scale is unknown"]})
    assert read_notices(scaling._report(older, 2.0)["warnings"]) == [Notice("uncoded", "frames were lost")]
    older.metric = True
    assert len(scaling._report(older, 2.0)["warnings"]) == 2


def test_everything_that_is_a_length_is_scaled(room: Map, half: Map) -> None:
    np.testing.assert_allclose(
        half.trajectory.T_world_cam[::8, :3, 3], 0.5 * room.trajectory.T_world_cam[::8, :3, 3], atol=1e-6
    )
    np.testing.assert_allclose(
        half.trajectory.T_world_cam[::8, :3, :3], room.trajectory.T_world_cam[::8, :3, :3], atol=1e-6
    )
    for name in ("means", "scales", "anchor_cam"):
        np.testing.assert_allclose(
            getattr(half.gaussians, name), 0.5 * getattr(room.gaussians, name), rtol=1e-5, atol=1e-7
        )
    for name in ("quats_wxyz", "opacities", "colors", "anchor_keyframe"):
        np.testing.assert_array_equal(getattr(half.gaussians, name), getattr(room.gaussians, name))
    own, before = half.occupancy, room.occupancy
    np.testing.assert_array_equal(own.voxels(1), before.voxels(1))
    np.testing.assert_allclose(own.centers(own.voxels(1)), 0.5 * before.centers(before.voxels(1)))
    np.testing.assert_allclose(half.keyframes.depth_m(2), 0.5 * room.keyframes.depth_m(2), atol=6e-4)
    np.testing.assert_array_equal(half.keyframes[2].color, room.keyframes[2].color)
    assert is_rigid(half.T_gravity_map)
    cameras = half.trajectory.T_world_keyframe[:, :3, 3]
    np.testing.assert_allclose(
        transform(half.T_gravity_map, cameras), 0.5 * transform(room.T_gravity_map, 2 * cameras), atol=1e-6
    )
    assert half.report["rendering"]["depth_l1_m"] == pytest.approx(0.5 * room.report["rendering"]["depth_l1_m"])
    assert (half.path / map_files.PATH_PICTURE).read_bytes() != (room.path / map_files.PATH_PICTURE).read_bytes()
    assert (half.path / map_files.RENDER_PICTURE).is_file()


def test_words_are_found_at_half_the_place(room: Map, half: Map) -> None:
    """Their order may change: a thing has a usual size."""
    found = [
        sorted(scan_map.query("red cup").regions, key=lambda region: len(region.rows)) for scan_map in (room, half)
    ]
    assert len(found[0]) > 1
    for big, small in zip(*found, strict=True):
        np.testing.assert_allclose(small.centroid, 0.5 * big.centroid, atol=1e-3)
        assert small.volume_m3 == pytest.approx(big.volume_m3 / 8)


def test_scaling_back_gives_the_map_that_it_was(room: Map, half: Map, tmp_path: Path) -> None:
    back = scaling.scale_map(half, 2.0, "length", tmp_path / "back")
    assert back.metric
    assert back.manifest.scale == MapScale(metric=True, by="length", factor=2.0)
    assert back.manifest.voxel_size_m == pytest.approx(room.manifest.voxel_size_m)
    np.testing.assert_allclose(back.gaussians.means, room.gaussians.means, rtol=1e-5)
    assert read_notices(back.report["warnings"]) == [ANOTHER], "that the scale is unknown is said no more"
    assert not list(tmp_path.glob("*.partial"))


def test_a_length_between_two_pixels_or_words(room: Map, half: Map) -> None:
    frame = room.keyframes[3]
    pixels = [(60, 120), (260, 130)]
    depth_m = open_capture("builtin:room", None, {"synthetic": {"width": 320, "height": 240}}).exact_depth(frame.index)  # type: ignore[attr-defined]
    camera = frame.intrinsics
    points = [
        ((x - camera.cx) / camera.fx * depth_m[y, x], (y - camera.cy) / camera.fy * depth_m[y, x], depth_m[y, x])
        for x, y in pixels
    ]
    true = float(np.linalg.norm(np.subtract(*points)))
    ends = [f"{frame.index}:{x},{y}" for x, y in pixels]
    assert scaling.scale_by_length(half, ends, true) == pytest.approx(2.0, rel=0.02)
    places = [half.query(word).regions[0].centroid for word in ("red cup", "green plant")]
    apart = 2 * float(np.linalg.norm(places[0] - places[1]))
    assert scaling.scale_by_length(half, ["red cup", "green plant"], apart) == pytest.approx(2.0)


def test_points_that_are_none_are_reported(half: Map) -> None:
    keyframe = int(half.trajectory.keyframes[1])
    with pytest.raises(MapError, match=r"Frame 1 is not a keyframe of .*; the nearest are 0, "):
        scaling.scale_by_length(half, ["1:5,5", "red cup"], 1.0)
    with pytest.raises(MapError, match=r"Pixel 999,5 is outside keyframe .*320 x 240"):
        scaling.scale_by_length(half, [f"{keyframe}:999,5", "red cup"], 1.0)
    with pytest.raises(MapError, match=r"'xylophone' matches nothing"):
        scaling.scale_by_length(half, ["xylophone", "red cup"], 1.0)
    with pytest.raises(MapError, match="are the same point of the map"):
        scaling.scale_by_length(half, ["red cup", "red cup"], 1.0)
    with pytest.raises(MapError, match="The length must be a positive number of meters"):
        scaling.scale_by_length(half, ["red cup", "blue chair"], -1.0)


def test_a_pixel_without_depth_takes_the_nearest_that_has_one(half: Map) -> None:
    depth_m = half.keyframes.depth_m(0).copy()
    depth_m[100:120, 100:120] = 0
    frame = int(half.trajectory.keyframes[0])

    class Holed:
        def __getattr__(self, name):
            return getattr(half, name)

    class Frames:
        folder = half.keyframes.folder

        def depth_m(self, row):
            return depth_m

        def views(self):
            return half.keyframes.views()

    holed = Holed()
    holed.keyframes = Frames()  # type: ignore[attr-defined]
    assert scaling.scale_by_length(holed, [f"{frame}:102,102", "red cup"], 1.0) > 0  # type: ignore[arg-type]
    with pytest.raises(MapError, match=rf"Keyframe {frame} has no depth within 6 pixels of 110,110"):
        scaling.scale_by_length(holed, [f"{frame}:110,110", "red cup"], 1.0)  # type: ignore[arg-type]


def pictured(depth_m: np.ndarray) -> SimpleNamespace:
    """A map of one keyframe, frame 7, whose camera has differing axes and stands away from the origin."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), (1.0, 2.0, 3.0)
    camera = Intrinsics(depth_m.shape[1], depth_m.shape[0], 50.0, 40.0, 21.0, 13.0)
    return SimpleNamespace(
        path=Path("map"),
        keyframes=SimpleNamespace(depth_m=lambda row: depth_m, views=lambda: [("image", camera)]),
        trajectory=SimpleNamespace(keyframes=np.array([7]), T_world_keyframe=T[None]),
    )


@pytest.mark.parametrize("pixel", [(20, 15), (0, 0), (39, 29), (3, 28)])
def test_a_pixel_takes_the_nearest_depth_that_is_at_most_six_pixels_away(pixel: tuple[int, int]) -> None:
    x, y = pixel
    for dx, dy in [(0, 0), (6, 0), (-6, 0), (0, 6), (0, -6), (6, -6), (-6, 6), (7, 0), (-7, 0), (0, 7), (0, -7)]:
        if not (0 <= x + dx < 40 and 0 <= y + dy < 30):
            continue
        depth = np.zeros((30, 40), np.float32)
        depth[y + dy, x + dx] = 2.0
        if max(abs(dx), abs(dy)) > 6:
            with pytest.raises(MapError, match=f"no depth within 6 pixels of {x},{y}"):
                scaling._point(pictured(depth), f"7:{x},{y}")
            continue
        seen = 2.0 * np.array(((x - 21.0) / 50, (y - 13.0) / 40, 1.0))
        wanted = (seen[2] + 1.0, seen[0] + 2.0, seen[1] + 3.0)
        np.testing.assert_allclose(scaling._point(pictured(depth), f" 7:{x},{y} "), wanted)
    for farther, nearer in (((4, 0), (0, 3)), ((-3, 3), (4, 0)), ((0, -5), (-2, -4))):
        depth = np.zeros((30, 40), np.float32)
        for (dx, dy), z in ((farther, 3.0), (nearer, 2.0)):
            depth[15 + dy, 20 + dx] = z
        np.testing.assert_allclose(scaling._point(pictured(depth), "7:20,15")[0], 1.0 + 2.0)


def test_a_pixel_beyond_the_image_or_the_keyframes_is_refused() -> None:
    depth = np.ones((30, 40), np.float32)
    for x, y in ((40, 0), (0, 30), (40, 30)):
        with pytest.raises(MapError, match=rf"Pixel {x},{y} is outside keyframe 7: 40 x 30 pixels"):
            scaling._point(pictured(depth), f"7:{x},{y}")
    many = pictured(depth)
    many.trajectory.keyframes = np.array([0, 10, 20, 30, 40])
    with pytest.raises(MapError, match="the nearest are 10, 20, 30\\."):
        scaling._point(many, "19:1,1")


def test_a_length_is_the_distance_of_its_ends() -> None:
    depth = np.full((30, 40), 2.0, np.float32)
    length = 2.0 * np.hypot(10 / 50, 8 / 40)
    assert scaling.scale_by_length(pictured(depth), ["7:5,6", "7:15,14"], 3.0) == pytest.approx(3.0 / length)


@pytest.mark.parametrize(("voxel_m", "depth_m", "factor"), [(0.05, 3.0, 0.02), (0.1, 3.0, 65.535 / 3)])
def test_the_smallest_and_the_largest_factor_of_a_map(voxel_m, depth_m, factor, monkeypatch) -> None:
    class Passed(Exception):
        """All checks of the factor are behind it."""

    def made_of(*_):
        raise Passed

    monkeypatch.setattr(scaling.WorkFolder, "made_of", made_of)
    frames = SimpleNamespace(depth_m=lambda row: np.array([[0.1, depth_m][row]]))
    frames = type("Frames", (), {"depth_m": staticmethod(frames.depth_m), "__len__": lambda _: 2})()
    given = SimpleNamespace(manifest=SimpleNamespace(finest_m=voxel_m), keyframes=frames, path=Path("map"))
    outwards = 1.001 if factor > 1 else 0.999
    with pytest.raises(Passed):
        scaling.scale_map(given, factor / outwards, "given", "out")
    with pytest.raises(MapError, match="check the length"):
        scaling.scale_map(given, factor * outwards, "given", "out")


def test_the_height_is_that_of_the_cameras_in_the_middle() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = ((5.0, -1.0, 0.0), (0.0, -2.0, 9.0), (0.0, -6.0, 4.0))
    T = np.array(((0.0, 0, 1, -1.0), (-1, 0, 0, 0), (0, -1, 0, 0.5), (0, 0, 0, 1)))
    given = SimpleNamespace(
        T_gravity_map=T,
        trajectory=SimpleNamespace(T_world_keyframe=poses),
        manifest=SimpleNamespace(upright=Upright(by="floor", off_deg=0.1, floor=True, walls=True)),
    )
    assert scaling.scale_by_camera_height(given, 5.0) == pytest.approx(5.0 / 2.5)


@pytest.mark.parametrize(("off", "fits"), [(0.08, True), (0.13, False)])
def test_poses_that_differ_by_a_tenth_of_their_spread_are_another_scans(tmp_path, off, fits) -> None:
    count = 40
    T = np.tile(np.eye(4), (count, 1, 1))
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    T[:, :3, 3] = np.stack((np.cos(angle), np.sin(angle), 0 * angle), axis=1)
    times = np.arange(float(count))
    trajectory = Trajectory(times, T, np.array([0], np.int32), np.full(count, "tracked"), np.ones(count, np.float32))
    other = T.copy()
    other[:, :3, 3] = 3.0 * (other[:, :3, 3] + np.outer(np.where(np.arange(count) % 2, off, -off), (0.0, 0.0, 1.0)))
    write_tum(tmp_path / "poses.txt", dataclasses.replace(trajectory, T_world_cam=other))
    given = SimpleNamespace(trajectory=trajectory)
    if fits:
        assert scaling.scale_by_poses(given, str(tmp_path / "poses.txt")) == pytest.approx(3.0, rel=1e-6)
    else:
        with pytest.raises(FreeOccError, match=r"at least 0\.39 m apart, and the camera path spreads over 3\.0"):
            scaling.scale_by_poses(given, str(tmp_path / "poses.txt"))


def test_every_length_of_a_manifest_is_scaled() -> None:
    T = np.eye(4)
    T[:3, 3] = 1.0, 2.0, 3.0
    said = tiny_manifest(
        origin=(1.0, -2.0, 3.0),
        finest_voxel_m=0.05,
        T_world_map=matrix(T),
        T_gravity_map=matrix(2 * T - np.eye(4)),
        scale=MapScale(metric=False, by="none", factor=1.5),
        refined=Refined(map="coarse", box=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0)),
    )
    made = scaling._manifest(SimpleNamespace(manifest=said), 2.0, "length")
    assert (made.voxel_size_m, made.finest_voxel_m, made.origin) == (0.2, 0.1, (2.0, -4.0, 6.0))
    assert made.scale == MapScale(metric=True, by="length", factor=3.0)
    assert made.refined is not None
    assert made.refined.box == (0.0, 2.0, 4.0, 6.0, 8.0, 10.0)
    for found, before in ((made.T_world_map, said.T_world_map), (made.T_gravity_map, said.T_gravity_map)):
        wanted = np.array(before)
        wanted[:3, 3] *= 2
        np.testing.assert_allclose(found, wanted)


def test_the_cameras_height_above_the_floor(half: Map, tmp_path: Path) -> None:
    """The camera goes at 1.5 m, up and down by 3 cm."""
    assert scaling.scale_by_camera_height(half, 1.5) == pytest.approx(2.0, rel=0.03)
    floorless = load_map(half.path)
    floorless.manifest = msgspec.structs.replace(half.manifest, upright=None)
    assert scaling.scale_by_camera_height(floorless, 1.5) == pytest.approx(2.0, rel=0.03)
    floorless.manifest = msgspec.structs.replace(
        half.manifest, upright=msgspec.structs.replace(half.manifest.upright, floor=False)
    )
    with pytest.raises(MapError, match="shows no floor below the cameras: give a known length"):
        scaling.scale_by_camera_height(floorless, 1.5)


def test_metric_poses_of_the_capture_or_of_a_file(room: Map, half: Map, tmp_path: Path) -> None:
    assert scaling.scale_by_poses(half, "builtin:room") == pytest.approx(2.0, rel=1e-4)
    assert scaling.scale_by_poses(half, str(room.path / map_files.TRAJECTORY)) == pytest.approx(2.0, rel=1e-4)
    rng = np.random.default_rng(0)
    T = room.trajectory.T_world_cam.copy()
    T[:, :3, 3] = rng.normal(size=(len(T), 3))
    write_tum(tmp_path / "other.txt", dataclasses.replace(room.trajectory, T_world_cam=T))
    with pytest.raises(FreeOccError, match=r"The poses of .*other\.txt are not this map's"):
        scaling.scale_by_poses(half, str(tmp_path / "other.txt"))


@pytest.mark.parametrize("factor", [0.0, -2.0, float("nan"), 1e-3, 1e3])
def test_factors_that_no_map_can_have_are_refused(half: Map, tmp_path: Path, factor: float) -> None:
    with pytest.raises(MapError, match=r"positive number|check the length"):
        scaling.scale_map(half, factor, "given", tmp_path / "out")
    assert not list(tmp_path.iterdir())


def answers(scan_map: Map) -> list[dict]:
    return json.loads(run("query", scan_map.path, "red cup", "--json").stdout)["results"][0]["regions"]


def test_the_commands_say_what_the_unit_is(room: Map, half: Map, tmp_path: Path) -> None:
    assert "scale      unknown: lengths are not meters" in run("info", half.path).stdout
    facts = json.loads(run("info", half.path, "--json").stdout)
    assert facts["metric"] is False
    assert json.loads(run("info", room.path, "--json").stdout)["scale"]["by"] == "sensor"
    assert "edge 0.04 units\n" in run("info", half.path).stdout
    assert "edge 0.08 m\n" in run("info", room.path).stdout
    unknown, known = (run("query", scan_map.path, "red cup").stdout for scan_map in (half, room))
    assert "lengths are not meters" in unknown
    assert "lengths are not meters" not in known
    assert "(m)" not in unknown
    assert "(l)" not in unknown
    (header, row, *_), (header_m, row_l, *_) = (text.splitlines()[1:] for text in (unknown, known))
    for name in ("centroid (units)", "size (units)", "volume (units^3)"):
        assert name in header
    assert header_m.split("conf.")[1].split() == ["centroid", "(m)", "size", "(m)", "volume", "(l)", "voxels"]
    # A row's columns end, and a volume stands, where the header says; half as large is an eighth of the volume.
    assert (len(row), len(row_l)) == (len(header), len(header_m))
    volumes = [sorted(region["volume_m3"] for region in answers(scan_map)) for scan_map in (half, room)]
    np.testing.assert_allclose(8 * np.array(volumes[0]), volumes[1])
    assert float(row.split()[-2]) == pytest.approx(answers(half)[0]["volume_m3"], rel=0.02)
    assert float(row_l.split()[-2]) == pytest.approx(1000 * answers(room)[0]["volume_m3"], rel=0.02)
    assert "voxels of 0.04 units," in map_pictures.map_title(half)
    assert "voxels of 8 cm," in map_pictures.map_title(room)
    assert json.loads(run("query", half.path, "red cup", "--json").stdout)["metric"] is False
    exported = run("export", half.path, "--format", "octomap", "-o", tmp_path / "half.bt")
    assert "lengths are not meters" in exported.stderr
    described = json.loads((tmp_path / "half.bt.json").read_text())
    assert (described["metric"], described["unit"]) == (False, "unknown")
    shown = run("scale", half.path, "-o", tmp_path / "meters", "--camera-height", "1.5").stdout
    assert "scale      meters, by the cameras' height, 2" in shown
    assert "exists" in refused("scale", half.path, "-o", tmp_path / "meters", "--factor", "2")
    assert "cannot replace it" in refused("scale", half.path, "-o", half.path, "--factor", "2", "--overwrite")
    wrong = run("scale", half.path, "-o", tmp_path / "two", "--factor", "2", "--camera-height", "1.5", code=2)
    assert "give one of --factor" in wrong.stderr


def test_given_trackers_know_whether_their_poses_are_metric(tmp_path: Path, room: Map) -> None:
    from freeocc3d.capture import Options

    def metric(folder: Path, **options) -> bool:
        return known.load(known.Options(), open_capture(folder, Options(**options))).metric

    assert metric(write_nerfstudio(tmp_path / "depth", 3))
    assert metric(tmp_path / "depth", depth=False)
    assert not metric(write_nerfstudio(tmp_path / "color", 3, depth=False))
    assert metric(tmp_path / "color", scale=2.0)
    assert not metric(write_colmap(tmp_path / "model", 3))
    poses = tmp_path / "depth" / "transforms.json"
    capture = open_capture(tmp_path / "depth", Options(depth=False))
    tracker = file.load(file.Options(path=str(poses), scale=None), capture)
    assert not tracker.metric
    assert file.load(file.Options(path=str(poses), scale=1.0), capture).metric
    scaled = file.load(
        file.Options(path=str(poses), scale=None), open_capture(tmp_path / "depth", Options(depth=False, scale=3.0))
    )
    assert scaled.metric
    np.testing.assert_allclose(scaled.T_world_cam[:, :3, 3], 3 * tracker.T_world_cam[:, :3, 3])


def test_a_map_of_unknown_scale_is_scored_at_the_true_one(half: Map, tmp_path: Path) -> None:
    truth = tmp_path / "truth.npz"
    fewer = {"capture.stride": 4, "capture.synthetic.width": 320, "capture.synthetic.height": 240}
    run("ground-truth", "builtin:room", "-o", truth, *(f"--set={name}={value}" for name, value in fewer.items()))
    scored = json.loads(run("evaluate", half.path, "--ground-truth", truth, "--json").stdout)
    assert scored["align"] == "sim3"
    assert scored["alignment"]["scale"] == pytest.approx(2.0)
    as_it_is = json.loads(run("evaluate", half.path, "--ground-truth", truth, "--align", "se3", "--json").stdout)
    assert scored["iou"] > 0.5 > 10 * as_it_is["iou"]
