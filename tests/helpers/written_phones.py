"""Writes scans as the apps of phones do."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import lzfse
import numpy as np
from numpy.typing import NDArray
from ros_bags import encode
from scans import Scan, write_exr
from small_captures import write_image

from freeocc3d.core.transforms import invert

ARKIT_VIDEO = "47333462"
STRAY_COLUMNS = "timestamp, frame, x, y, z, qx, qy, qz, qw"
STRAY_MORE_COLUMNS = f"{STRAY_COLUMNS}, fx, fy, cx, cy, distortion_center_x, distortion_center_y"

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""A camera of ARKit looks along -z."""

_TICKS = 90_000


def write_lossless(
    path: Path, images: Sequence[NDArray[np.uint8]], times: Sequence[float] | None = None, rotation: int = 0
) -> Path:
    """A video whose frames come back as they were. times: seconds, by default 60 frames a second.  rotation: degrees,
    counterclockwise, by which a player has to turn the frames."""
    at = [i / 60 for i in range(len(images))] if times is None else [time - times[0] for time in times]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", rate=60, options={"qp": "0", "preset": "ultrafast"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "rgb24"
        if rotation:
            stream.set_display_rotation(rotation)
        stream.time_base = stream.codec_context.time_base = Fraction(1, _TICKS)
        for seconds, image in zip(at, images, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = round(seconds * _TICKS), Fraction(1, _TICKS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def write_stray(root: Path, scan: Scan, newer: bool = True, video: bool = True) -> Path:
    """newer: odometry.csv states a camera per frame."""
    root.mkdir(exist_ok=True)
    if video:
        write_lossless(root / "rgb.mp4", scan.color)
    for i in range(len(scan)):
        if not video:
            write_image(root / "rgb" / f"{i:06d}.png", scan.color[i])
        write_image(root / "depth" / f"{i:06d}.png", scan.stored(i))
        write_image(root / "confidence" / f"{i:06d}.png", scan.sure((0, 1, 2)))
    write_odometry(root / "odometry.csv", scan, newer)
    rows = (", ".join(map(str, row)) for row in scan.K.tolist())
    (root / "camera_matrix.csv").write_text("\n".join(rows) + "\n")
    return root


def write_odometry(path: Path, scan: Scan, newer: bool = True) -> None:
    lines = [STRAY_MORE_COLUMNS if newer else STRAY_COLUMNS]
    for i, (time, camera) in enumerate(zip(scan.times, scan.cameras, strict=True)):
        numbers = [*scan.T_world_cam[i][:3, 3].tolist(), *scan.quat_xyzw(i)]
        line = f"{time:.6f}, {i:06d}, " + ", ".join(f"{number:.9f}" for number in numbers)
        lines.append(line + (f", {camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}, , " if newer else ""))
    path.write_text("\n".join(lines) + "\n")


def write_arkitscenes(root: Path, scan: Scan, color: str = "lowres_wide") -> Path:
    """color: name of the folder of color. The times of the released camera files and poses differ from those of the
    images by up to a millisecond."""
    lines = []
    (root / f"{color}_intrinsics").mkdir(parents=True)
    for i, time in enumerate(scan.times):
        name, camera = f"{ARKIT_VIDEO}_{time:.3f}", scan.cameras[i]
        write_image(root / color / f"{name}.png", scan.color[i])
        write_image(root / "lowres_depth" / f"{name}.png", scan.stored(i))
        write_image(root / "confidence" / f"{name}.png", scan.sure((0, 1, 2)))
        stated = " ".join(map(repr, (*scan.size, camera.fx, camera.fy, camera.cx, camera.cy)))
        (root / f"{color}_intrinsics" / f"{ARKIT_VIDEO}_{time + 0.001:.3f}.pincam").write_text(stated)
        T = invert(scan.T_world_cam[i])
        turn = cv2.Rodrigues(T[:3, :3])[0][:, 0].tolist()
        lines.append(" ".join(map(repr, (time + 0.0004, *turn, *T[:3, 3].tolist()))))
    (root / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    return root


def polycam_stamps(scan: Scan) -> list[int]:
    """Names of keyframes: microseconds since the device was started, which is 2.7 hours before the first."""
    return [9_876_543_210_123 + round((time - scan.times[0]) * 1e6) for time in scan.times]


def polycam_camera(scan: Scan, index: int, **changes: Any) -> dict[str, Any]:
    T, camera = scan.T_world_cam[index] @ _OPENGL, scan.cameras[index]
    stated = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    places = {f"t_{row}{column}": T[row, column] for row in range(3) for column in range(4)}
    size = {"width": scan.size[0], "height": scan.size[1]}
    return {**stated, **size, **places, "blur_score": 80.0, "manual_keyframe": False, **changes}


def write_polycam(root: Path, scan: Scan, prefix: str = "") -> Path:
    """prefix: "corrected_" for what replaces the images and cameras after closing loops."""
    (root / f"{prefix}cameras").mkdir(parents=True, exist_ok=True)
    for i, stamp in enumerate(polycam_stamps(scan)):
        write_image(root / f"{prefix}images" / f"{stamp}.png", scan.color[i])
        write_image(root / "depth" / f"{stamp}.png", scan.stored(i))
        write_image(root / "confidence" / f"{stamp}.png", scan.sure((0, 127, 255)))
        (root / f"{prefix}cameras" / f"{stamp}.json").write_text(json.dumps(polycam_camera(scan, i)))
    return root


def record3d_metadata(scan: Scan, **changes: Any) -> dict[str, Any]:
    cameras = [[camera.fx, camera.fy, camera.cx, camera.cy] for camera in scan.cameras]
    poses = [[*scan.quat_xyzw(i, opengl=True), *T[:3, 3].tolist()] for i, T in enumerate(scan.T_world_cam)]
    stated = {
        "w": scan.size[0], "h": scan.size[1], "dw": scan.depth_size[0], "dh": scan.depth_size[1], "fps": 60,
        "K": scan.K.T.reshape(-1).tolist(), "poses": poses, "frameTimestamps": list(scan.times),
        "perFrameIntrinsicCoeffs": cameras,
    }  # fmt: skip
    return {**stated, **changes}


def record3d_members(scan: Scan, **changes: Any) -> dict[str, bytes]:
    """The files of an .r3d. changes: of the metadata. Color is stored without loss under the usual name."""
    files = {"metadata": json.dumps(record3d_metadata(scan, **changes)).encode()}
    sure = lzfse.compress(scan.sure((0, 1, 2)).tobytes())
    for i in range(len(scan)):
        files[f"rgbd/{i}.jpg"] = encode(scan.color[i], ".png")
        files[f"rgbd/{i}.depth"] = lzfse.compress(scan.depth_m[i].astype("<f4").tobytes())
        files[f"rgbd/{i}.conf"] = sure
    return files


def write_members(path: Path, files: Mapping[str, bytes], method: int | None = zipfile.ZIP_STORED) -> Path:
    """An archive, or a folder without a method."""
    if method is None:
        for name, data in files.items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(data)
        return path
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def write_record3d_exr(root: Path, scan: Scan) -> Path:
    """The export as EXR and images."""
    for i in range(len(scan)):
        write_image(root / "rgb" / f"{i}.png", scan.color[i])
        write_exr(root / "depth" / f"{i}.exr", scan.depth_m[i], "R")
    (root / "metadata.json").write_text(json.dumps(record3d_metadata(scan)))
    return root
