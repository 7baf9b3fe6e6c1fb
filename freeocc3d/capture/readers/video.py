"""A video file (mp4, mov, mkv, webm, avi, …): upright, at its own times, each frame by its index.

The file is read through once when it is opened, without decoding, so that every frame's time is known and none has to
be counted to. A frame is decoded from where the decoder stands if that is on the way, else from the last key frame
before it: reading in ascending order, with any stride, passes through the file once.
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
from ...core.types import Frame, Intrinsics
from ..base import Capture, Options
from ..camera_files import convert_35mm, guess_camera, read_given_calibration, reduce_camera
from ..image_decoding import Size

REQUIRES: tuple[str, ...] = ("av",)

FOCAL_35MM = "focal_length.35mm_equivalent"
"""How the tag ends in which phones state the lens (com.apple.quicktime.camera.…)."""

_LEAST_FRAMES = 2
_NEVER = -(1 << 62)


class Reader(Capture):
    """Timestamps are the file's own, in seconds, of constant or variable rate. A rotation that the file states is
    applied, pixels that are not square are made so, and images are reduced to ``capture.max_size``.

    The camera is ``capture.intrinsics``, for the size that the upright video has before it is reduced; else a guess,
    from the lens that a phone may state. Raises CaptureError: not a video, nothing decodes, a codec that is not there.
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
    """One video stream. Not thread-safe.

    keys: (N,) int64 presentation times in units of ``time_base``, ascending.  upright_size: of the frames with square
    pixels, after their rotation.
    """

    def __init__(self, path: Path):
        self.path = path
        self._open()
        keys, starts = self._read_through()
        if len(keys) < _LEAST_FRAMES:
            raise CaptureError(
                f"{path} is no video that can be used: it holds {len(keys)} frame{'s' if len(keys) != 1 else ''}. Is "
                "it cut off, or an image? Images are read as a folder of many."
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
        """Focal length in millimeters of a 35 mm camera with the same view; 0 where nothing states it."""
        tags = {**self._container.metadata, **self._stream.metadata}
        stated = (value for name, value in tags.items() if name.lower().endswith(FOCAL_35MM))
        try:
            return float(next(stated, 0.0))
        except ValueError:
            return 0.0

    def image(self, index: int, size: Size) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB of a frame, upright, resampled to ``size``. Raises FrameError."""
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
        """The frame of that time; None if the file has it in its list, but nothing decodes to it."""
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
        """To a key frame; to the beginning where a container goes beyond what it is asked for."""
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
        """Frames from where the file stands; what does not decode is left out."""
        import av

        for packet in self._container.demux(self._stream):
            with contextlib.suppress(av.error.InvalidDataError):
                yield from packet.decode()

    def _first_frame(self) -> Any:
        """The first that decodes, by which a file that does not decode at all is told when it is opened."""
        import av

        try:
            self._seek(int(self._starts[0]))
            self._last = next(self._frames)
            return self._last
        except (av.error.FFmpegError, StopIteration) as error:
            raise CaptureError(
                f"{self.path} cannot be decoded ({self._stream.codec_context.name}): no frame comes out of it. Convert "
                "it, for example with ffmpeg, to H.264 in mp4."
            ) from error

    def _open(self) -> None:
        """Raises CaptureError."""
        import av

        try:
            self._container = av.open(str(self.path))
        except (av.error.FFmpegError, OSError) as error:
            raise CaptureError(
                f"{self.path} is no video that can be read ({error.strerror}): a capture is a folder of frames, or a "
                "video file that is whole."
            ) from error
        streams = [stream for stream in self._container.streams.video if stream.codec_context is not None]
        pictured = [stream for stream in streams if not stream.disposition & av.stream.Disposition.attached_pic]
        if not pictured:
            raise CaptureError(f"{self.path} holds no video, or of a kind that this build of FFmpeg cannot decode.")
        self._stream = pictured[0]
        self._stream.thread_type = "AUTO"

    def _read_through(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Times of all frames and of those that decoding can start at, ascending. What a file that is cut off still
        holds is taken."""
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
    """When a packet or a frame is shown; where a container (AVI) does not say it, when it is decoded."""
    stated = timed.dts if timed.pts is None else timed.pts
    return _NEVER if stated is None else int(stated)
