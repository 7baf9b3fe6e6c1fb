"""Reads recordings of an Azure Kinect (.mkv): color, depth and calibration, without Microsoft's libraries.

k4arecorder and Open3D write such files: the tracks COLOR (MJPG, NV12 or YUY2), DEPTH and IR (b16g: 16-bit gray,
big-endian, depth in millimeters), and an attached calibration.json. Open3D's own reader needs libk4arecord, which its
wheel lacks. Source: "Azure Kinect Sensor SDK recording file format", learn.microsoft.com, and the SDK's code. This
reader was written from them and tested with files made after them, for no recording was at hand.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError
from ...core.image_files import Size
from ...core.regular_files import open_regular
from ...core.warnings import Notice
from ..base import Options
from ..cameras.azure_kinect_cameras import read_calibration
from ..cameras.rigs import Rig, StatedCameras, build_rig
from ..files.file_bytes import DamagedFile
from ..files.time_pairs import pair_streams
from ..images.depth_decoding import MILLIMETERS, RawDepth
from ..images.image_decoding import decode_color_bytes
from ..rgbd_frames import Registration, RgbdFrames
from ..videos.matroska_files import START, MatroskaFile, Track, read_tracks

REQUIRES: tuple[str, ...] = ()

COLOR, DEPTH = "COLOR", "DEPTH"
"""Names of tracks, and the part of the tags that name other tracks."""

_DEPTH_CODEC = "b16g"
_RAW_COLOR = {"NV12": (1.5, cv2.COLOR_YUV2RGB_NV12), "YUY2": (2.0, cv2.COLOR_YUV2RGB_YUY2)}
"""Codec -> bytes per pixel, and OpenCV's conversion."""
_JPEG = "MJPG"
_MOST_PIXELS = 1 << 25


class Reader(RgbdFrames):
    """A frame is a color image and the depth image that is nearest in time. Images without a partner within half an
    interval are left out. Depth is registered to the color camera by the recording's calibration."""

    format = "azure_kinect"
    layout = "a recording of an Azure Kinect (.mkv) with color and depth"
    reads_files = True

    def __init__(self, path: Path, options: Options):
        try:
            self._file = MatroskaFile(path)
        except DamagedFile as error:
            raise CaptureError(f"{path} is not a readable recording of an Azure Kinect: {error}.") from error
        except OSError as error:
            raise CaptureError(f"Cannot read {error.filename or path}: {error.strerror}.") from error
        self._color = self._track(COLOR, path)
        self._depth = self._track(DEPTH, path) if options.depth else None
        times, self._rows, notices = self._pair_images(path)
        self.warnings = (*self._warn_of_end(path, len(times)), *notices)
        super().__init__(path, options, times, MILLIMETERS)
        color, depth = _size(self._color, path), _size(self._depth, path) if self._depth else None
        self._rig, self.intrinsics_known = build_rig(self._stated(color, depth), options, color, depth)
        self.focal_stated = self.intrinsics_known
        Registration(self._rig)  # raises CaptureError for a rig of too large images

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """Whether a file has a track of depth, as no other video has."""
        try:
            with open_regular(path) as stream:
                if stream.read(len(START)) != START:
                    return False
            return any(track.fourcc == _DEPTH_CODEC for track in read_tracks(path))
        except (OSError, DamagedFile):
            return False

    def stored_color(self, index: int) -> NDArray[np.uint8]:
        data, what = self._block(self._color, index, 0)
        if self._color.fourcc == _JPEG or self._color.codec == "V_MJPEG":
            return decode_color_bytes(data, Path(what))
        per_pixel, conversion = _RAW_COLOR[self._color.fourcc]
        width, height = self._color.width, self._color.height
        if len(data) != round(width * height * per_pixel):
            raise FrameError(f"{what} is cut off: it has {len(data)} bytes for {width} x {height} pixels.")
        rows = np.frombuffer(data, np.uint8)
        shape = (height * 3 // 2, width) if per_pixel == 1.5 else (height, width, 2)
        return cv2.cvtColor(rows.reshape(shape), conversion)

    def stored_depth(self, index: int) -> RawDepth | None:
        if self._depth is None:
            return None
        data, what = self._block(self._depth, index, 1)
        width, height = self._depth.width, self._depth.height
        if len(data) != 2 * width * height:
            raise FrameError(f"{what} is cut off: it has {len(data)} bytes for {width} x {height} pixels.")
        return np.frombuffer(data, ">u2").reshape(height, width).astype(np.uint16)

    def rig(self, index: int) -> Rig:
        return self._rig

    def _block(self, track: Track, index: int, stream: int) -> tuple[bytes, str]:
        """The data of a frame's color (0) or depth (1), and what it is in words. Raises FrameError."""
        what = f"Image {self._rows[index, stream]} of the track {track.name or track.number} in {self.path}"
        try:
            return self._file.block(track, int(self._rows[index, stream])), what
        except (DamagedFile, OSError) as error:
            raise FrameError(f"{what} cannot be read: {error}.") from error

    def _track(self, name: str, path: Path) -> Track:
        """The track that a tag names, or that has the name. Raises CaptureError."""
        stated = self._file.tags.get(f"K4A_{name}_TRACK", "")
        known = (_DEPTH_CODEC,) if name == DEPTH else (_JPEG, *_RAW_COLOR)
        for track in sorted(self._file.tracks, key=lambda track: str(track.uid) != stated):
            if (str(track.uid) == stated or track.name.upper() == name) and not track.packed:
                if track.fourcc in known or (name == COLOR and track.codec == "V_MJPEG"):
                    return track
                raise CaptureError(
                    f"{path} holds {name.lower()} as {track.fourcc or track.codec}, which is not read: record "
                    f"{' or '.join(known)}."
                )
        hint = ": map color only with capture.depth=false" if name == DEPTH else ""
        raise CaptureError(f"{path} holds no track of {name.lower()} images{hint}.")

    def _pair_images(self, path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64], tuple[Notice, ...]]:
        """(N,) seconds, (N, 2) rows of the color and depth images of frames, and warnings. Raises CaptureError."""
        color = self._file.times_s[self._color.number]
        if not len(color):
            raise CaptureError(f"{path} holds no images: is it cut off?")
        if self._depth is None:
            return color, np.repeat(np.arange(len(color))[:, None], 2, axis=1), ()
        pairs, notices = pair_streams(path, (color, self._file.times_s[self._depth.number]))
        return color[pairs[:, 0]], pairs, notices

    def _warn_of_end(self, path: Path, frames: int) -> tuple[Notice, ...]:
        if not self._file.cut_off:
            return ()
        text = f"{path} is cut off: the {frames} frames before its end are used. Copy the file again to have all."
        return (Notice("images-left-out", text),)

    def _stated(self, color: Size, depth: Size | None) -> StatedCameras:
        name = self._file.tags.get("K4A_CALIBRATION_FILE") or "calibration.json"
        data = self._file.attachment(name)
        if data is None:
            raise CaptureError(f"{self.path} lacks the attachment {name}, which describes its cameras.")
        return read_calibration(data, color, depth, str(self.path))


def _size(track: Track, path: Path) -> Size:
    if not 0 < track.width * track.height <= _MOST_PIXELS:
        raise CaptureError(f"{path} states images of {track.width} x {track.height} pixels, which is not possible.")
    return track.width, track.height
