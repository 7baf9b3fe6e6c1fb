"""Decodes a video file with FFmpeg, and serves frames to another process (``main``).

FFmpeg may loop, abort or take all memory for a hostile file, so ``video_process`` runs this module in a process of its
own, with bounded memory. Only containers of cameras and phones are opened, without files that they name.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import mmap
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError, FreeOccError
from ...core.image_files import Size
from ...core.regular_files import check_content, open_regular

FOCAL_35MM = "focal_length.35mm_equivalent"
"""End of the tag in which phones state the lens (com.apple.quicktime.camera.…)."""

CONTAINERS = "mov,matroska,avi,mpegts,mpeg,asf,flv,ogg,h264,hevc"
"""FFmpeg's names of the formats that are opened. Others render text, or open files and addresses that they name."""

RAW_STREAMS = ("h264", "hevc")
"""Formats that are only the packets of a codec of the same name, without times."""

MOST_PIXELS = 1 << 26
MOST_BYTES = 2304 << 20
"""Largest memory of the process that decodes: enough for 8K video, less than 2 GB of it used."""

BEAT_S = 1.0
"""Seconds after which a process at work says so."""

_MOST_THREADS = 8
_LEAST_FRAMES = 2
_NEVER = -(1 << 62)
_SLOWEST, _FASTEST = 1, 240  # frames a second; some encoders state their clock instead


_OPEN_OPTIONS = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}


class VideoDecoder:
    """Decodes one video stream. Not thread-safe. The constructor raises CaptureError.

    beat: is called often.  keys: (N,) int64 presentation times in units of ``time_base``, ascending.  upright_size:
    size of the frames with square pixels, after the rotation that the file states if ``upright`` is true.

    Some streams do not say when a frame is shown: raw ones, and H.264 in AVI, which states the order of decoding. Their
    frames are counted as they come out of the decoder, which is the order of display, always from the first one.
    """

    def __init__(self, path: Path, beat: Callable[[], None] = lambda: None, upright: bool = True):
        self.path, self._beat = path, beat
        _refuse_text(path)
        self._open()
        keys, starts = self._read_through()
        if len(keys) < _LEAST_FRAMES:
            raise CaptureError(
                f"{path} is not a usable video: it holds {len(keys)} frame{'s' if len(keys) != 1 else ''}. Is it cut "
                "off, or an image? Give images as a folder of many."
            )
        self.keys, self._starts = keys, starts
        self.time_base = _frame_time(self._stream) if self._raw else self._stream.time_base
        self._frames: Iterator[tuple[int, Any]] = iter(())
        self._last: tuple[int, Any] | None = None
        first = self._first_frame()
        self._turns = round(first.rotation / 90) % 4 if upright else 0
        aspect = self._stream.sample_aspect_ratio
        width, height = round(first.width * float(aspect)) if aspect else first.width, first.height
        self.upright_size: Size = (height, width) if self._turns % 2 else (width, height)
        if not (width > 0 and height > 0 and width * height <= MOST_PIXELS):
            raise CaptureError(f"{path} states {width} x {height} pixels, which is not possible: convert the video.")

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
            frame = self._frame(index if self._counted else int(self.keys[index]))
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
        """The frame at that time, or of that number; None if the file lists it but it does not decode."""
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        start = self._starts[max(int(np.searchsorted(self._starts, key, side="right")) - 1, 0)]
        if self._last is None or not start <= self._last[0] < key:
            self._seek(int(start))
        for found, frame in self._frames:
            self._last = found, frame
            if found >= key:
                return frame if found == key else None
        raise StopIteration

    def _seek(self, start: int) -> None:
        """Go to a key frame, or to the beginning if the container jumps past the requested time."""
        self._last = first = None
        if not self._counted:
            self._container.seek(start, stream=self._stream)
            frames = self._decoded()
            first = next(frames, None)
        if first is None or first[0] > start:
            self._open()
            frames = self._decoded()
            first = next(frames)
        self._frames = itertools.chain((first,), frames)

    def _decoded(self) -> Iterator[tuple[int, Any]]:
        """Decode frames, with their times or numbers, from the current position; skip packets that do not decode."""
        import av

        numbers = itertools.count()
        for packet in self._packets():
            with contextlib.suppress(av.error.InvalidDataError):
                for frame in packet.decode():
                    self._beat()
                    yield next(numbers) if self._counted else _key(frame), frame

    def _packets(self) -> Iterator[Any]:
        """The packets from the current position. A damaged index may list the same bytes again and again: once the
        packets hold far more than the file, they end."""
        left = 4 * self.path.stat().st_size + (1 << 20)
        for packet in self._container.demux(self._stream):
            self._beat()
            left -= packet.size + 1
            if left < 0:
                return
            yield packet

    def _first_frame(self) -> Any:
        """The first frame that decodes. Raises CaptureError on opening if none does."""
        import av

        try:
            self._seek(int(self._starts[0]))
            self._last = next(self._frames)
            return self._last[1]
        except (av.error.FFmpegError, StopIteration) as error:
            raise CaptureError(
                f"No frame of {self.path} can be decoded ({self._stream.codec_context.name}). Convert the video to "
                "H.264 in mp4, for example with ffmpeg."
            ) from error

    def _open(self) -> None:
        """Open the file. Raises CaptureError."""
        import av

        try:
            self._container = av.open(f"file:{self.path.absolute()}", options=_OPEN_OPTIONS)
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
        self._raw = self._container.format.name in RAW_STREAMS
        in_avi = self._container.format.name == "avi" and self._stream.codec_context.name in RAW_STREAMS
        self._counted = self._raw or (in_avi and self._stream.codec_context.has_b_frames)
        self._stream.thread_type = "AUTO"
        self._stream.codec_context.thread_count = min(os.cpu_count() or 1, _MOST_THREADS)
        self._stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}

    def _read_through(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Times of all frames and of the key frames, ascending. Of a cut-off file, the existing part is used."""
        import av

        keys, starts = list[int](), list[int]()
        try:
            for packet in self._packets():
                key = len(keys) if self._raw else _key(packet)
                if packet.size and not packet.is_discard and key > _NEVER:
                    keys.append(key)
                    if packet.is_keyframe:
                        starts.append(key)
        except av.error.FFmpegError:
            pass
        found = np.unique(np.array(keys, np.int64))
        if self._counted:
            return found - found[:1], np.zeros(1, np.int64)
        return found, np.unique(np.array(starts or keys[:1], np.int64))


def _frame_time(stream: Any) -> Fraction:
    """Seconds per frame of a raw stream, by the rate that it states; 1 if it states none."""
    rate = stream.codec_context.framerate
    return 1 / Fraction(rate) if rate and _SLOWEST <= rate <= _FASTEST else Fraction(1)


def _key(timed: Any) -> int:
    """Presentation time of a packet or frame; its decoding time if the container (AVI) does not state it."""
    stated = timed.dts if timed.pts is None else timed.pts
    return _NEVER if stated is None else int(stated)


def _refuse_text(path: Path) -> None:
    """Raise CaptureError for a file that is not regular, or holds text; FFmpeg would draw the text."""
    try:
        check_content(path)
        with open_regular(path) as stream:
            head = stream.read(4096)
    except OSError as error:
        raise CaptureError(f"Cannot read {path}: {error.strerror}.") from error
    if head and not set(head) & _NOT_OF_TEXT:
        raise CaptureError(
            f"{path} is a text file, not a readable video: a capture is a folder of frames, or a complete video file."
        )


_NOT_OF_TEXT = set(range(32)) - set(b"\t\n\v\f\r\x1b")


def main() -> None:
    """Serve the frames of the video that the command line names: ``path shared-memory parent upright``.

    Each line that comes in asks for a frame, {"index", "width", "height"}; the answer is {} when its (height, width, 3)
    pixels are in the shared memory, or {"error"}. The first line that goes out describes the video. An empty line says
    that the work goes on.
    """
    path, memory, parent = Path(os.fsdecode(sys.argv[1])), int(sys.argv[2]), int(sys.argv[3])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES if hard < 0 else min(MOST_BYTES, hard), hard))
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    told = [time.monotonic()]

    def beat() -> None:
        if time.monotonic() > told[0] + BEAT_S:
            told[0] = time.monotonic()
            print(flush=True)

    try:
        decoder = VideoDecoder(path, beat, upright=sys.argv[4] == "1")
    except (FreeOccError, MemoryError) as error:
        print(json.dumps({"error": str(error) or f"{path} needs too much memory: convert the video."}), flush=True)
        return
    base = decoder.time_base
    print(json.dumps({
        "keys": decoder.keys.tolist(), "numerator": base.numerator, "denominator": base.denominator,
        "size": decoder.upright_size, "focal_35mm": decoder.focal_35mm,
    }), flush=True)  # fmt: skip
    shared: mmap.mmap | None = None
    for line in sys.stdin:
        asked = json.loads(line)
        told[0] = time.monotonic()
        try:
            image = decoder.image(asked["index"], (asked["width"], asked["height"]))
            if shared is None or len(shared) != image.nbytes:
                shared = mmap.mmap(memory, image.nbytes)
            shared[:] = image.data
            print("{}", flush=True)
        except (FreeOccError, MemoryError) as error:
            print(json.dumps({"error": str(error) or f"Frame {asked['index']} needs too much memory."}), flush=True)


def _end_with(parent: int) -> None:
    """End this process when its parent has ended, whatever FFmpeg does."""
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)
