"""Damaged captures, trajectories, class files, point clouds and videos, of which everything is read."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuzz._damage import damage, damage_archive, damage_folder, replace
from fuzz._scans import write_scans
from fuzz.harness import Attack, Silent

SHORT = 60

FRAMES = 4
READERS = ("scannet", "replica", "seven_scenes", "nerfstudio", "lidar", "colmap_txt", "colmap_bin", "photos")
SCANS = "scans"
IMAGES = (".png", ".jpg", ".tif", ".tiff", ".webp", ".bmp", ".npy", ".npz", ".exr", ".pgm", ".pfm", ".depth", ".conf")
VIDEOS = ("scan.mp4", "scan.avi", "scan.mkv")


def prepare(folder: Path) -> None:
    """One tiny capture of each format, and the files that go with captures."""
    import posed_captures
    import pycolmap
    import small_captures
    import videos

    small_captures.write_scannet(folder / "scannet", FRAMES, suffix="jpg")
    for camera in ("color", "depth"):
        small_captures.write_matrix(folder / "scannet" / "intrinsic" / f"extrinsic_{camera}.txt", np.eye(4))
    small_captures.write_replica(folder / "replica", FRAMES, classes=True)
    small_captures.write_seven_scenes(folder / "seven_scenes", FRAMES)
    posed_captures.write_nerfstudio(folder / "nerfstudio", FRAMES, depth=False, k1=-0.02, ply_file_path="points.ply")
    posed_captures.write_nerfstudio(folder / "lidar", FRAMES)
    posed_captures.write_colmap(folder / "colmap_txt", FRAMES, camera="OPENCV 32 24 32 32 16 12 -0.01 0 0 0")
    posed_captures.write_colmap(folder / "colmap_bin", FRAMES)
    model = folder / "colmap_bin" / "sparse" / "0"
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    for path in model.glob("*.txt"):
        path.unlink()
    _write_photos(folder / "photos")
    for name in VIDEOS:
        videos.write_video(folder / name, 12, codec="mpeg4" if name.endswith("avi") else "libx264")
    _write_files(folder / "files")
    (folder / SCANS).mkdir()
    write_scans(folder / SCANS)
    shutil.copy(folder / "files" / "points.ply", folder / "nerfstudio" / "points.ply")
    shutil.copytree(folder / "replica" / "semantic_class", folder / "labels")
    (folder / "labels" / "classes.txt").write_text("nothing\nsofa\nlamp\n")
    _reconstruct(folder / "scannet", folder / "map")  # compiles what an input shall not wait for


def _write_photos(folder: Path) -> None:
    from PIL import Image
    from small_captures import color_image

    folder.mkdir()
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769).update({0xA405: 26, 0x9003: "2024:01:02 03:04:05", 0x920A: 4.2})
    for n, suffix in enumerate(("jpg", "jpg", "png", "tif", "webp", "bmp")):
        Image.fromarray(color_image(n)).save(folder / f"IMG_{n}.{suffix}", **({"exif": exif} if n < 2 else {}))


def _write_files(folder: Path) -> None:
    """Trajectories in every form, class files, and point clouds."""
    import open3d as o3d
    from small_captures import pose_matrix

    from freeocc3d.core.transforms import rotations_to_quats

    folder.mkdir()
    T = np.stack([pose_matrix(n) for n in range(FRAMES)])
    quats = rotations_to_quats(T[:, :3, :3])
    np.savetxt(folder / "tum.txt", np.column_stack((np.arange(FRAMES), T[:, :3, 3], quats[:, [1, 2, 3, 0]])))
    np.savetxt(folder / "kitti.txt", T.reshape(-1, 16)[:, :12])
    with (folder / "poses.log").open("w") as log:
        for n, pose in enumerate(T):
            log.write(f"{n} {n} {n + 1}\n")
            np.savetxt(log, pose)
    (folder / "classes.txt").write_text("nothing\nsofa\nlamp\n")
    (folder / "classes.yaml").write_text("classes: [nothing, sofa]\nmap:\n  chair: sofa\n  rug: null\n")
    (folder / "classes.json").write_text(json.dumps({"classes": ["nothing", "sofa"], "map": {"chair": "sofa"}}))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.random.default_rng(0).uniform(-1, 1, (50, 3)) + 2))
    for name, ascii_form in (("points.ply", False), ("text.ply", True), ("points.pcd", False), ("text.pcd", True)):
        o3d.io.write_point_cloud(str(folder / name), cloud, write_ascii=ascii_form)
    o3d.io.write_point_cloud(str(folder / "packed.pcd"), cloud, compressed=True)
    o3d.io.write_point_cloud(str(folder / "points.xyz"), cloud)


def attack(rng: random.Random, originals: Path, folder: Path) -> Attack:
    """One damaged input of a random kind."""
    kind = rng.random()
    if kind < 0.25:
        return _capture_attack(rng, originals / rng.choice(READERS), folder)
    if kind < 0.72:
        return _capture_attack(rng, rng.choice(sorted((originals / SCANS).iterdir())), folder)
    if kind < 0.81:
        return _video_attack(rng, originals, folder)
    return _file_attack(rng, originals, folder)


def _capture_attack(rng: random.Random, original: Path, folder: Path) -> Attack:
    """A damaged copy of a sound capture; of one that is a file, the file is given."""
    name = original.name
    scan = folder / name
    shutil.copytree(original, scan)
    files = sorted(path for path in scan.rglob("*") if path.is_file())
    documents = [path for path in files if path.suffix not in IMAGES]
    inner = sorted(scan.iterdir())
    given = inner[0] if len(inner) == 1 and rng.random() < 0.8 else scan
    if files[0].suffix == ".r3d" and rng.random() < 0.5:
        told = damage_archive(rng, files[0])
    elif rng.random() < 0.1:
        places = [scan, *sorted(path for path in scan.iterdir() if path.is_dir())]
        told = damage_folder(rng, rng.choice(places))
    else:
        told = damage(rng, rng.choice(documents if documents and rng.random() < 0.6 else files))
    left = sorted(path for path in scan.rglob("*") if path.is_file() and not path.is_symlink())
    if left and rng.random() < 0.1:
        told += "; " + damage(rng, rng.choice(left))
    depth = rng.random() > 0.1
    whole = rng.random() < 0.02
    run = (lambda: _reconstruct(given, folder / "map")) if whole else (lambda: _read(given, depth))
    return Attack(f"{name}: {told}{' (reconstruct)' if whole else ''}", run)


def _video_attack(rng: random.Random, originals: Path, folder: Path) -> Attack:
    name = rng.choice(VIDEOS)
    path = folder / name
    kind = rng.random()
    if kind < 0.75:
        shutil.copy(originals / name, path)
        told = damage(rng, path)
    elif kind < 0.9:
        other = rng.choice(sorted(path for path in (originals / "files").iterdir()))
        path = folder / rng.choice((other.name, name))
        shutil.copy(other, path)
        told = f"is {other.name}"
    else:
        path = folder / rng.choice(("list.m3u8", "list.ffconcat", "list.sdp", "scan.mp4", "list.mpd"))
        path.write_text(
            rng.choice(
                (
                    f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{originals / VIDEOS[0]}\n#EXT-X-ENDLIST\n",
                    f"ffconcat version 1.0\nfile {originals / VIDEOS[0]}\n",
                    "#EXTM3U\n#EXTINF:10,\nhttp://127.0.0.1:9/x.ts\n",
                    "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n",
                )
            )
        )
        told = "a list that names other files"
    return Attack(f"video {name}: {told}", lambda: _read(path, True))


def _file_attack(rng: random.Random, originals: Path, folder: Path) -> Attack:
    shutil.copytree(originals / "files", folder / "files")
    scan = originals / "seven_scenes"
    if rng.random() < 0.2:
        shutil.copytree(originals / "labels", folder / "labels")
        told = damage(rng, rng.choice(sorted((folder / "labels").iterdir())))
        return Attack(f"labels: {told}", lambda: _read_labels(scan, folder / "labels"))
    if rng.random() < 0.2:
        picture = folder / "picture.png"
        shutil.copy(rng.choice(sorted((originals / "photos").iterdir())), picture)
        told = damage(rng, picture)
        return Attack(f"picture: {told}", lambda: _read_picture(picture))
    path = rng.choice(sorted((folder / "files").iterdir()))
    told = replace(rng, path) if rng.random() < 0.1 else damage(rng, path)
    if path.name.startswith("classes"):
        return Attack(f"classes: {told}", lambda: _read_classes(path))
    if path.suffix in (".ply", ".pcd", ".xyz"):
        return Attack(f"points: {told}", lambda: _read_points(path))
    return Attack(f"trajectory: {told}", lambda: _read_trajectory(path, scan))


def _read(path: Path, depth: bool) -> None:
    """Open a capture, decode it, and read all that it states; the frames that cannot be decoded are counted."""
    from freeocc3d.capture import open_capture
    from freeocc3d.capture.base import Options
    from freeocc3d.capture.checks.depth_units import settle_depth_unit
    from freeocc3d.core.errors import CaptureError, FrameError

    capture = open_capture(path, Options(depth=depth))
    if capture.has_depth:
        settle_depth_unit(capture)
    broken: list[FrameError] = []
    for index in range(min(len(capture), 40)):
        try:
            frame = capture[index]
        except FrameError as error:
            broken.append(error)
            continue
        height, width = frame.color.shape[:2]
        camera = frame.intrinsics
        _expect(frame.depth_m.shape == (height, width) == (camera.height, camera.width), "sizes differ")
        _expect(np.isfinite(frame.depth_m).all() and (frame.depth_m >= 0).all(), "depth is not finite")
        _expect(np.isfinite(camera.matrix).all() and camera.fx > 0 and camera.fy > 0, "no possible camera")
        _expect(np.isfinite(frame.timestamp), "no time")
        capture.name(index)
        capture.turned(index)
        try:
            capture.labels(index)
        except FrameError as error:
            broken.append(error)
    for index in range(min(len(capture), 40)):
        _check_pose(capture.pose(index))
    if broken and len(broken) >= len(capture):
        raise CaptureError(f"no frame is readable: {broken[0]}")


def _reconstruct(path: Path, output: Path) -> None:
    from freeocc3d import reconstruct

    settings = {"tracking": {"backend": "known"}, "fitting": {"passes": 0}, "capture": {"max_broken": 0.5}}
    reconstruct(path, output, settings)


def _read_labels(scan: Path, folder: Path) -> None:
    from freeocc3d.capture import open_capture
    from freeocc3d.language.encoders import labels

    capture = open_capture(scan)
    encoder = labels.load(labels.Options(folder=str(folder)), capture)
    for index in range(len(capture)):
        _expect(np.isfinite(encoder.encode(capture[index])).all(), "a feature is not finite")


def _read_picture(path: Path) -> None:
    from freeocc3d.query import image_query

    class Colors:
        @staticmethod
        def encode(frame: Any) -> Any:
            return frame.color[::4, ::4].astype(np.float16) + np.float16(1)

    encoder: Any = Colors()
    image_query.patch_feature(encoder, path)


def _read_classes(path: Path) -> None:
    from freeocc3d.capture.class_files import read_class_file

    found = read_class_file(path)
    found.grouping(found.names)
    _expect(bool(found.names) and all(isinstance(name, str) for name in found.names), "no names")
    json.dumps([found.names, found.targets], ensure_ascii=False).encode()


def _read_points(path: Path) -> None:
    from freeocc3d.capture.point_files import read_points

    points = read_points(path)
    _expect(bool(len(points)) and np.isfinite(points.astype(np.float32)).all(), "points are not finite")


def _read_trajectory(path: Path, scan: Path) -> None:
    from freeocc3d.capture import open_capture, read_trajectory

    found = read_trajectory(path)
    found.times()
    for pose in found.of_frames(open_capture(scan)):
        _check_pose(pose if np.isfinite(pose).any() else None)


def _check_pose(pose: NDArray[np.float64] | None) -> None:
    from freeocc3d.core.transforms import is_rigid

    if pose is not None:
        _expect(is_rigid(pose, 2e-3) and np.abs(pose).max() <= 1e9, "a pose is not rigid")


def _expect(right: object, wrong: str) -> None:
    if not right:
        raise Silent(wrong)
