"""Scans in memory, for the code that writes them in every format."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from numpy.typing import NDArray
from small_captures import SIZE, camera_matrix, color_image, depth_image, pose_matrix, write_image

from freeocc3d.capture import open_capture
from freeocc3d.core.transforms import rotations_to_quats
from freeocc3d.core.types import Frame, Intrinsics

START_S = 1_700_000_000.25
"""When the frames of scans begin, seconds since 1970."""


@dataclass(frozen=True)
class Scan:
    """Frames with depth. color: (H, W, 3) RGB.  depth_m: (h, w) meters, 0 = none.  cameras: of color.  times: seconds,
    ascending.  confidence: (h, w) of 0, 1, 2; None = all are high."""

    color: Sequence[NDArray[np.uint8]]
    depth_m: Sequence[NDArray[np.float32]]
    cameras: Sequence[Intrinsics]
    T_world_cam: Sequence[NDArray[np.float64]]
    times: Sequence[float]
    confidence: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return len(self.color)

    @property
    def size(self) -> tuple[int, int]:
        return self.color[0].shape[1], self.color[0].shape[0]

    @property
    def depth_size(self) -> tuple[int, int]:
        return self.depth_m[0].shape[1], self.depth_m[0].shape[0]

    @property
    def K(self) -> NDArray[np.float64]:
        """(3, 3) of the first frame's color."""
        return self.cameras[0].matrix

    @property
    def depth_K(self) -> NDArray[np.float64]:
        """(3, 3) of the first frame's depth, which shows what its color shows."""
        return self.cameras[0].resized(*self.depth_size).matrix

    def stored(self, index: int, units: float = 1000.0) -> NDArray[np.uint16]:
        """Depth in whole units, so many per meter."""
        return np.rint(self.depth_m[index].astype(np.float64) * units).astype(np.uint16)

    def quat_xyzw(self, index: int, opengl: bool = False) -> list[float]:
        """The turn of a pose, of a camera that looks along -z if ``opengl``."""
        R = self.T_world_cam[index][None, :3, :3] * ((1, -1, -1) if opengl else 1)
        w, x, y, z = rotations_to_quats(R)[0].tolist()
        return [x, y, z, w]

    def sure(self, levels: tuple[int, int, int]) -> NDArray[np.uint8]:
        """(h, w) confidence, where low, medium and high have these values."""
        high = np.full(self.depth_size[::-1], 2, np.uint8)
        return np.array(levels, np.uint8)[high if self.confidence is None else self.confidence]


def plane_scan(
    count: int,
    size: tuple[int, int] = SIZE,
    depth_size: tuple[int, int] | None = None,
    unsure: bool = False,
    times: Sequence[float] | None = None,
) -> Scan:
    """The images and poses of ``small_captures``. unsure: depth has medium confidence in 8 columns, of which the last
    two are low.  depth_size: by default, that of color."""
    depth_size = depth_size or size
    fx, fy, cx, cy = camera_matrix(size)[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    confidence = np.full(depth_size[::-1], 2, np.uint8)
    confidence[:, -8:], confidence[:, -2:] = 1, 0
    return Scan(
        [color_image(i, size) for i in range(count)],
        [(depth_image(i, size=depth_size) / 1000).astype(np.float32) for i in range(count)],
        [Intrinsics(*size, fx + i, fy + i, cx, cy) for i in range(count)],
        [pose_matrix(i) for i in range(count)],
        times if times is not None else [START_S + i / 30 + 0.002 * (i % 3) for i in range(count)],
        confidence if unsure else None,
    )


def assert_confidence_counts(frame: Frame, index: int) -> None:
    """A frame of an unsure ``plane_scan`` has no depth of low confidence, and twice the deviation at medium."""
    wanted = depth_image(index, size=frame.depth_m.shape[::-1]) / 1000
    wanted[:, -2:] = 0
    np.testing.assert_allclose(frame.depth_m, wanted, atol=1e-6)
    assert frame.depth_sigma_m is not None
    np.testing.assert_allclose(frame.depth_sigma_m[1, -5], 2 * frame.depth_sigma_m[1, 5], rtol=1e-6)


@functools.cache
def room_scan(count: int = 6, width: int = 160, height: int = 120) -> Scan:
    """The first frames of the walk through the built-in room, with times and focal lengths that vary."""
    own = {"synthetic": {"frames": 240, "width": width, "height": height}}
    room = open_capture("builtin:room", None, own)
    frames = [room[i] for i in range(count)]
    K = frames[0].intrinsics
    return Scan(
        [frame.color for frame in frames],
        [frame.depth_m for frame in frames],
        [Intrinsics(width, height, K.fx + 0.5 * i, K.fy + 0.25 * i, K.cx, K.cy) for i in range(count)],
        [room.pose(i) for i in range(count)],
        [START_S + round(i / 30, 3) + 0.002 * (i % 3) for i in range(count)],
    )


def write_depth(path: Path, depth_m: NDArray[np.float32], units: float = 1000.0) -> None:
    """Depth in the form that the suffix states: integers of so many units per meter, or floats in meters."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = depth_m.shape
    stored = np.rint(depth_m.astype(np.float64) * units).astype(np.uint16)
    if path.suffix == ".npy":
        np.save(path, depth_m)
    elif path.suffix == ".npz":
        np.savez(path, depth=depth_m)
    elif path.suffix == ".exr":
        write_exr(path, depth_m)
    elif path.suffix == ".pgm":
        path.write_bytes(b"P5\n%d %d\n65535\n" % (width, height) + stored.astype(">u2").tobytes())
    elif path.suffix == ".pfm":
        path.write_bytes(b"Pf\n%d %d\n-1.0\n" % (width, height) + depth_m[::-1].astype("<f4").tobytes())
    elif path.suffix == ".tiff":
        assert cv2.imwrite(str(path), depth_m)
    else:
        write_image(path, stored)


def write_exr(path: Path, depth_m: NDArray[np.float32], channel: str = "Z") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {channel: np.ascontiguousarray(depth_m)}).write(str(path))


def pose_line(time: float, T_world_cam: NDArray[np.float64]) -> str:
    """A line of TUM's trajectories."""
    w, x, y, z = rotations_to_quats(T_world_cam[None, :3, :3])[0]
    return " ".join(repr(float(number)) for number in (time, *T_world_cam[:3, 3], x, y, z, w)) + "\n"


def log_entry(index: int, T_world_cam: NDArray[np.float64]) -> str:
    """An entry of Open3D's trajectories."""
    rows = "".join(" ".join(map(repr, row)) + "\n" for row in T_world_cam.tolist())
    return f"{index} {index} {index + 1}\n{rows}"
