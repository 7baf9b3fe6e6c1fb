"""Reads a video file (mp4, mov, mkv, webm, avi, …): upright frames by index, with the file's own times.

Opening reads the whole file once, without decoding, to know the time of every frame. Decoding a frame continues from
the decoder's position or starts at the last key frame before the frame, whichever is nearer. So reading in ascending
order, with any stride, passes through the file once.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError
from ...core.image_files import Size
from ...core.types import Frame, Intrinsics
from ..base import Capture, Options
from ..camera_files import convert_35mm, guess_camera, read_given_calibration, reduce_camera

REQUIRES: tuple[str, ...] = ("av",)

FOCAL_35MM = "focal_length.35mm_equivalent"
"""End of the tag in which phones state the lens (com.apple.quicktime.camera.…)."""

_LEAST_FRAMES = 2
_NEVER = -(1 << 62)


class Reader(Capture):
    """Timestamps are the file's own, in seconds, at a constant or variable rate. The stated rotation is applied, pixels
    become square, and images are reduced to ``capture.max_size``.

    The camera is ``capture.intrinsics``, for the upright size before reduction; else a guess, based on the lens if the
    file states it. Raises CaptureError: not a video, no decodable frame, or a missing codec.
    """

    format = "video"
    layout = "a video file, such as scan.mp4 or scan.mov"
    has_depth = False

    def __init__(self, path: Path, options: Options):
        super().__init__(path, options)
        self._lock = threading.Lock()
        self._decoder = _Decoder(path)
        self.timestamps = np.asarray(self._decoder.keys * float(self._decoder.time_base), np.float64)
        size = self._decoder.upright_size
        lens = convert_35mm(self._decoder.focal_35mm, size)
        stated = read_given_calibration(options)
        camera = stated.camera(size) if stated else lens or guess_camera(size)
        self.intrinsics_known, self.focal_stated = stated is not None, stated is not None or lens is not None
        self.intrinsics: Intrinsics = reduce_camera(camera, options.max_size)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return path.is_file()

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"Frame {index} of a video of {len(self)} frames.")
        camera = self.intrinsics
        with self._lock:
            color = self._decoder.image(index, (camera.width, camera.height))
        depth_m = np.zeros(color.shape[:2], np.float32)
        return Frame(index, float(self.timestamps[index]), color, depth_m, camera)


class _Decoder:
    """Decodes one video stream. Not thread-safe.

    keys: (N,) int64 presentation times in units of ``time_base``, ascending.  upright_size: size of the frames with
    square pixels, after rotation.
    """

    def __init__(self, path: Path):
        self.path = path
        self._open()
        keys, starts = self._read_through()
        if len(keys) < _LEAST_FRAMES:
            raise CaptureError(
                f"{path} is not a usable video: it holds {len(keys)} frame{'s' if len(keys) != 1 else ''}. Is it cut "
                "off, or an image? Give images as a folder of many."
            )
        self.keys, self._starts = keys, starts
        self.time_base = self._stream.time_base
        self._frames: Iterator[Any] = iter(())
        self._last: Any = None
        first = self._first_frame()
        self._turns = round(first.rotation / 90) % 4
        aspect = self._stream.sample_aspect_ratio
        width, height = round(first.width * float(aspect)) if aspect else first.width, first.height
        self.upright_size: Size = (height, width) if self._turns % 2 else (width, height)

    @property
    def focal_35mm(self) -> float:
        """35 mm equivalent focal length, millimeters; 0 if not stated."""
        tags = {**self._container.metadata, **self._stream.metadata}
        stated = (value for name, value in tags.items() if name.lower().endswith(FOCAL_35MM))
        try:
            return float(next(stated, 0.0))
        except ValueError:
            return 0.0

    def image(self, index: int, size: Size) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB of an upright frame, resampled to ``size``. Raises FrameError."""
        import av

        try:
            frame = self._frame(int(self.keys[index]))
        except (av.error.FFmpegError, StopIteration) as error:
            self._last = None
            said = "the file ends before it" if isinstance(error, StopIteration) else str(error)
            raise FrameError(f"Frame {index} of {self.path} cannot be decoded: {said}.") from error
        if frame is None or frame.is_corrupt:
            raise FrameError(f"Frame {index} of {self.path} is damaged.")
        width, height = size[::-1] if self._turns % 2 else size
        color = frame.to_ndarray(format="rgb24", width=width, height=height, interpolation="AREA")
        return np.ascontiguousarray(np.rot90(color, self._turns))

    def _frame(self, key: int) -> Any:
        """The frame at that time; None if the file lists it but it does not decode."""
        if self._last is not None and _key(self._last) == key:
            return self._last
        start = self._starts[max(int(np.searchsorted(self._starts, key, side="right")) - 1, 0)]
        if self._last is None or not start <= _key(self._last) < key:
            self._seek(int(start))
        for frame in self._frames:
            self._last = frame
            if _key(frame) >= key:
                return frame if _key(frame) == key else None
        raise StopIteration

    def _seek(self, start: int) -> None:
        """Go to a key frame, or to the beginning if the container jumps past the requested time."""
        self._last = None
        self._container.seek(start, stream=self._stream)
        frames = self._decoded()
        first = next(frames, None)
        if first is None or _key(first) > start:
            self._open()
            frames = self._decoded()
            first = next(frames)
        self._frames = itertools.chain((first,), frames)

    def _decoded(self) -> Iterator[Any]:
        """Decode frames from the current position; skip packets that do not decode."""
        import av

        for packet in self._container.demux(self._stream):
            with contextlib.suppress(av.error.InvalidDataError):
                yield from packet.decode()

    def _first_frame(self) -> Any:
        """The first frame that decodes. Raises CaptureError on opening if none does."""
        import av

        try:
            self._seek(int(self._starts[0]))
            self._last = next(self._frames)
            return self._last
        except (av.error.FFmpegError, StopIteration) as error:
            raise CaptureError(
                f"No frame of {self.path} can be decoded ({self._stream.codec_context.name}). Convert the video to "
                "H.264 in mp4, for example with ffmpeg."
            ) from error

    def _open(self) -> None:
        """Open the file. Raises CaptureError."""
        import av

        try:
            self._container = av.open(str(self.path))
        except (av.error.FFmpegError, OSError) as error:
            raise CaptureError(
                f"{self.path} is not a readable video ({error.strerror}): a capture is a folder of frames, or a "
                "complete video file."
            ) from error
        streams = [stream for stream in self._container.streams.video if stream.codec_context is not None]
        pictured = [stream for stream in streams if not stream.disposition & av.stream.Disposition.attached_pic]
        if not pictured:
            raise CaptureError(
                f"{self.path} holds no video that this build of FFmpeg can decode: convert it to H.264 in mp4."
            )
        self._stream = pictured[0]
        self._stream.thread_type = "AUTO"

    def _read_through(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Times of all frames and of the key frames, ascending. Of a cut-off file, the existing part is used."""
        import av

        keys, starts = [], []
        try:
            for packet in self._container.demux(self._stream):
                if packet.size and not packet.is_discard and _key(packet) > _NEVER:
                    keys.append(_key(packet))
                    if packet.is_keyframe:
                        starts.append(_key(packet))
        except av.error.FFmpegError:
            pass
        found = np.unique(np.array(keys, np.int64))
        return found, np.unique(np.array(starts or keys[:1], np.int64))


def _key(timed: Any) -> int:
    """Presentation time of a packet or frame; its decoding time if the container (AVI) does not state it."""
    stated = timed.dts if timed.pts is None else timed.pts
    return _NEVER if stated is None else int(stated)
