"""Writes scans as recordings of sensors: .sens files, ROS bags, and .mkv files of the Azure Kinect."""

from __future__ import annotations

import copy
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from azure_kinect_files import CALIBRATION, write_recording
from numpy.typing import NDArray
from ros_bags import Kind, Messages, Sent, encode, stored_file, write_bag
from scans import Scan
from written_folders import widen

COLOR, DEPTH = "/camera/color", "/camera/aligned_depth_to_color"
NARROW = 640, 576
"""Width and height of depth of the mode NFOV unbinned."""


def write_sens(
    path: Path,
    scan: Scan,
    kinds: tuple[int, int] = (1, 1),
    T_rig_depth: NDArray[np.float64] | None = None,
    stated: int | None = None,
    sizes: tuple[tuple[int, int], tuple[int, int]] | None = None,
) -> Path:
    """Field by field, after ScanNet's sensorData.h: no Python package writes the format.

    kinds: packing of color (0 plain, 1 PNG, 2 JPEG) and depth (0 plain, 1 zlib).  sizes: of color and depth that the
    header states, by default those of the scan.  stated: count of frames. Poses that are NaN are those of lost frames.
    """
    color_size, depth_size = sizes or (scan.size, scan.depth_size)
    K_color, K_depth = (widen(scan.cameras[0].resized(*size).matrix) for size in (color_size, depth_size))
    matrices = [K_color, np.eye(4), K_depth, np.eye(4) if T_rig_depth is None else T_rig_depth]
    out = bytearray(struct.pack("<IQ", 4, 9) + b"Structure")
    for matrix in matrices:
        out += matrix.astype("<f4").tobytes()
    out += struct.pack("<2i4IfQ", *kinds, *color_size, *depth_size, 1000.0, len(scan) if stated is None else stated)
    for index, (image, time) in enumerate(zip(scan.color, scan.times, strict=True)):
        color = image.tobytes() if kinds[0] == 0 else encode(image, ".png" if kinds[0] == 1 else ".jpg")
        depth = scan.stored(index).astype("<u2").tobytes()
        depth = zlib.compress(depth) if kinds[1] == 1 else depth
        pose = np.nan_to_num(scan.T_world_cam[index], nan=-np.inf)
        out += pose.astype("<f4").tobytes() + struct.pack("<4Q", round(time * 1e6), 7, len(color), len(depth))
        out += color + depth
    path.write_bytes(out + struct.pack("<Q", 0))  # no inertial measurements
    return path


def write_ros(path: Path, scan: Scan, kind: Kind, compressed: bool = False, packing: str = "") -> Path:
    """Color and aligned depth of one camera with its poses in tf. compressed: as PNG.  packing: of the bag's chunks or
    messages."""
    messages = Messages(kind)
    K = scan.K
    info = messages.info(scan.size, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), frame="color")
    sent: list[Sent] = [(f"{COLOR}/camera_info", round(scan.times[0] * 1e9), info)]
    for i, time in enumerate(scan.times):
        at = round(time * 1e9) + 5_000_000
        moved = messages.transforms(("map", "color", scan.T_world_cam[i]))
        moved.transforms[0].header = messages.header(time, "map")
        sent.append(("/tf", at, moved))
        depth = scan.stored(i)
        if compressed:
            packed = struct.pack("<iff", 0, 0, 0) + encode(depth, ".png")
            color = messages.compressed(encode(scan.color[i], ".png"), "rgb8; png compressed bgr8", time, "color")
            told = messages.compressed(packed, "16UC1; compressedDepth png", time, "color")
            sent += [(f"{COLOR}/image_raw/compressed", at, color), (f"{DEPTH}/image_raw/compressedDepth", at + 1, told)]
        else:
            sent.append((f"{COLOR}/image_raw", at, messages.image(scan.color[i], "rgb8", time, "color")))
            sent.append((f"{DEPTH}/image_raw", at + 1, messages.image(depth, "16UC1", time, "color")))
    return write_bag(path, messages, sent, packing)


def write_mcap(path: Path, scan: Scan, compressed: bool = False, packing: str = "") -> Path:
    """The file alone."""
    return stored_file(write_ros(path, scan, "mcap", compressed, packing))


def write_azure_kinect(path: Path, scan: Scan) -> Path:
    """Color of 640 x 480, without loss in a track of JPEG images, and depth that has empty rows below to fill a mode of
    the sensor."""
    assert scan.size == scan.depth_size == (640, 480)
    tracks = [("COLOR", "MJPG", scan.size), ("DEPTH", "b16g", NARROW)]
    blocks = []
    for i, time in enumerate(scan.times):
        depth = np.zeros(NARROW[::-1], ">u2")
        depth[:480] = scan.stored(i)
        since = time - scan.times[0]
        blocks += [(since, 0, encode(scan.color[i], ".png")), (since, 1, depth.tobytes())]
    return write_recording(path, tracks, blocks, calibration=_calibrate(scan.K))


def _calibrate(K: NDArray[np.float64]) -> dict[str, Any]:
    """One camera for color of 640 x 480 and, at the same place, for depth of ``NARROW``, which is a part of 1024 x
    1024."""
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]]
    of_color = np.array(((cx + 0.5) / 640, (cy + 0.5) / 480, fx / 640, fy / 480))
    of_depth = np.array((cx + 0.5 + 192, cy + 0.5 + 180, fx, fy)) / 1024
    stated = copy.deepcopy(CALIBRATION)
    for camera, parameters in zip(stated["CalibrationInformation"]["Cameras"], (of_depth, of_color), strict=True):
        camera["Intrinsics"]["ModelParameters"] = [*parameters.tolist(), *[0] * 10]
        camera["Rt"] = {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": [0, 0, 0]}
    return stated
