"""Every format and main variant: how it is written, by which reader it is read, and what it can hold."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import posed_captures
import written_folders as folders
import written_phones as phones
import written_recordings as recordings
from ros_bags import Kind
from scans import Scan
from small_captures import write_image

from freeocc3d.capture import Options
from freeocc3d.capture.files.image_suffixes import DEPTH_SUFFIXES

MILLIMETER = 0.001
_EXACT_S, _FLOATS = 1e-6, (".exr", ".npy", ".npz", ".pfm", ".tiff")


@dataclass(frozen=True)
class Written:
    """How a format is written, and what comes back.

    reader: that recognizes it.  unit_m: of stored depth; 0 = floats, which come back as they were; None = no depth.
    times_s: how exact times are that count from the first frame; None = frames are counted.  own_cameras: each frame
    has its camera.  registered: frames are what was stored; otherwise only the stored images are.  color, depth,
    confidence: how the images are encoded and, after a space, compressed; "plain" = not at all.
    """

    reader: str
    write: Callable[[Path, Scan], Path]
    unit_m: float | None = MILLIMETER
    times_s: float | None = None
    poses: bool = True
    own_cameras: bool = False
    registered: bool = True
    cameras: bool = True
    options: dict[str, Any] = field(default_factory=dict)
    size: tuple[int, int] = (160, 120)
    color: str = "png"
    depth: str = "png"
    confidence: str | None = None

    def make_options(self) -> Options:
        return Options(**self.options)


def _named(folder: str, write: Callable[..., Path], *arguments: Any, **more: Any) -> Callable[[Path, Scan], Path]:
    """A writer of a file of that name in the folder."""
    return lambda path, scan: write(path / folder, scan, *arguments, **more)


def _write_video(path: Path, scan: Scan) -> Path:
    return phones.write_lossless(path / "scan.mp4", scan.color, scan.times)


def _write_photos(path: Path, scan: Scan) -> Path:
    for i, image in enumerate(scan.color):
        write_image(path / f"IMG_{i + 8}.png", image)
    return path


def _write_r3d(path: Path, scan: Scan, method: int | None) -> Path:
    return phones.write_members(path / "scan.r3d", phones.record3d_members(scan), method)


def _ros(kind: Kind, compressed: bool = False, packing: str = "") -> Written:
    write: Callable[..., Path] = recordings.write_mcap if kind == "mcap" else partial(recordings.write_ros, kind=kind)
    name = "scan.bag" if kind == "bag" else "scan"
    form = "png" if compressed else f"plain {'zstd' if packing == 'message' else packing}".strip()
    form += " sqlite" if kind == "db3" else ""
    packed = {"color": form, "depth": form}
    return Written("ros_bag", _named(name, write, compressed=compressed, packing=packing), times_s=_EXACT_S, **packed)


def _phone(reader: str, write: Callable[[Path, Scan], Path], times_s: float = _EXACT_S, **more: Any) -> Written:
    return Written(reader, write, times_s=times_s, own_cameras=True, **{"confidence": "png", **more})


TUM = 1 / folders.TUM_UNITS
_LZFSE = {"color": "png", "depth": "plain lzfse", "confidence": "plain lzfse"}

WRITTEN: dict[str, Written] = {
    "ScanNet, exported": Written("scannet", folders.write_scannet),
    "ScanNet, .sens": Written(
        "scannet_sens", _named("scan.sens", recordings.write_sens), times_s=_EXACT_S, depth="plain zlib"
    ),
    "7-Scenes": Written("seven_scenes", folders.write_seven_scenes),
    "Replica": Written("replica", folders.write_replica, 1 / 6553.5),
    "TUM, lists": Written("tum_rgbd", folders.write_tum_with_camera, TUM, _EXACT_S),
    "TUM, associations": Written(
        "tum_rgbd", partial(folders.write_tum_with_camera, lists="associations"), TUM, _EXACT_S
    ),
    "TUM, names in seconds": Written("tum_rgbd", partial(folders.write_tum_with_camera, lists=""), TUM, _EXACT_S),
    **{
        f"folders, names in {unit}": Written(
            "image_folders", partial(folders.write_counted_times, per_second=per_second), times_s=_EXACT_S
        )
        for unit, per_second in (("milliseconds", 10**3), ("microseconds", 10**6), ("nanoseconds", 10**9))
    },
    **{
        f"folders, depth as {suffix}": Written(
            "image_folders",
            partial(folders.write_pairs, color="rgb/img_{:04d}.png", depth=f"depths/depth_{{:04d}}{suffix}"),
            0 if suffix in _FLOATS else MILLIMETER,
            options={} if suffix in _FLOATS else {"depth_scale": 1000.0},
            depth=suffix.removeprefix("."),
        )
        for suffix in sorted(DEPTH_SUFFIXES)
    },
    "one folder": Written(
        "image_folders",
        partial(folders.write_pairs, color="{:04d}-color.png", depth="{:04d}-depth.png"),
        options={"depth_scale": 1000.0},
    ),
    "Open3D": Written("image_folders", folders.write_open3d, options={"depth_scale": 1000.0}),
    "Redwood": Written("image_folders", folders.write_redwood, times_s=_EXACT_S, options={"depth_scale": 1000.0}),
    "RTAB-Map": Written(
        "image_folders", folders.write_rtabmap, own_cameras=True, options={"depth_scale": 1000.0}, confidence="png"
    ),
    "BundleFusion": Written("bundlefusion", folders.write_bundlefusion),
    "3RScan": Written(
        "bundlefusion",
        partial(folders.write_bundlefusion, images="sequence", info="_info.txt", depth="pgm"),
        depth="pgm",
    ),
    "ARKitScenes": _phone("arkitscenes", phones.write_arkitscenes, 0.001),
    "Stray Scanner, video": _phone("stray_scanner", phones.write_stray, color="video"),
    "Stray Scanner, images": _phone("stray_scanner", partial(phones.write_stray, video=False)),
    **{
        f"Record3D, {name}": _phone(
            "record3d", partial(_write_r3d, method=method), unit_m=0, **packing
        )
        for name, method, packing in (
            (".r3d", zipfile.ZIP_STORED, _LZFSE),
            (".r3d, deflated", zipfile.ZIP_DEFLATED, {kind: f"{form} zlib" for kind, form in _LZFSE.items()}),
            ("folder", None, _LZFSE),
        )
    },
    "Record3D, EXR": _phone("record3d", phones.write_record3d_exr, unit_m=0, depth="exr", confidence=None),
    "Polycam": _phone("polycam", phones.write_polycam),
    "nerfstudio, millimeters": Written("nerfstudio", posed_captures.write_transforms, own_cameras=True),
    "nerfstudio, stated unit": Written(
        "nerfstudio",
        partial(posed_captures.write_transforms, units=4000, depth_unit_scale_factor=0.00025),
        0.00025,
        own_cameras=True,
    ),
    "nerfstudio, arrays": Written(
        "nerfstudio",
        partial(posed_captures.write_transforms, depth="depth/frame_{}.npy"),
        0,
        own_cameras=True,
        depth="npy",
    ),
    "NeRFCapture": Written(
        "nerfstudio",
        partial(posed_captures.write_transforms, units=6553.5, key="depth_path", integer_depth_scale=10 / 65535),
        1 / 6553.5,
        own_cameras=True,
    ),
    "nerfstudio, color": Written(
        "nerfstudio", partial(posed_captures.write_transforms, depth=None), None, own_cameras=True, options={"scale": 1}
    ),
    "COLMAP, text": Written(
        "colmap_model", posed_captures.write_model, None, own_cameras=True, options={"scale": 1}
    ),
    "COLMAP, binary": Written(
        "colmap_model", posed_captures.write_binary_model, None, own_cameras=True, options={"scale": 1}
    ),
    "ROS 1": _ros("bag"),
    "ROS 1, compressed": _ros("bag", compressed=True),
    "ROS 1, chunks in LZ4": _ros("bag", packing="lz4"),
    "ROS 2, db3": _ros("db3"),
    "ROS 2, db3, messages in Zstandard": _ros("db3", packing="message"),
    "MCAP": _ros("mcap"),
    "MCAP, compressed": _ros("mcap", compressed=True),
    "MCAP, chunks in Zstandard": _ros("mcap", packing="zstd"),
    "Azure Kinect": Written(
        "azure_kinect", _named("scan.mkv", recordings.write_azure_kinect), times_s=_EXACT_S, poses=False,
        registered=False, size=(640, 480), depth="big",
    ),
    "video": Written(
        "video", _write_video, None, 1e-4, poses=False, cameras=False, color="video", options={"max_size": None}
    ),
    "photographs": Written("photos", _write_photos, None, poses=False, cameras=False, options={"max_size": None}),
}  # fmt: skip
