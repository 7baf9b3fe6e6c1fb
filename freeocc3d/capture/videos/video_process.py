"""Decodes a video in a process of its own, because FFmpeg may loop, abort or take all memory for a hostile file.

Measured on two cores: a start costs 0.2 s of processor time, and a frame 0.9 ms beside 1.4 ms of decoding at 640 x 480,
0.2 to 1.7 ms beside 7 ms at 1920 x 1080, little beside what a run does with a frame. So every video is decoded this
way, in at most 2.4 GB, and a process that shows no progress is ended.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import select
import subprocess
import sys
import tempfile
import time
import weakref
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...core.errors import CaptureError, FrameError
from ...core.image_files import Size
from ...core.typed_documents import InvalidDocument, as_type, parse_json

SILENT_S = 15.0
"""Seconds without a sign of work after which the process is ended."""

_MOST_STARTS = 4
_LONGEST_ANSWER = 256 << 20
_CODE = "from freeocc3d.capture.videos.video_decoding import main; main()"

T = TypeVar("T")
_Natural = Annotated[int, Meta(gt=0, le=1 << 31)]


class Described(msgspec.Struct, frozen=True):
    """A video. keys: presentation times of the frames, ascending, in units of numerator / denominator seconds.  size:
    upright.  focal_35mm: millimeters, 0 = not stated."""

    keys: list[int]
    numerator: _Natural
    denominator: _Natural
    size: tuple[_Natural, _Natural]
    focal_35mm: float

    @property
    def times(self) -> NDArray[np.float64]:
        """(N,) seconds."""
        return np.asarray(np.array(self.keys, np.int64) * (self.numerator / self.denominator), np.float64)


class _Answer(msgspec.Struct):
    error: str | None = None


class _Ended(Exception):
    """The process has ended, or must be. The message is part of a sentence."""


class VideoProcess:
    """Frames of a video, decoded elsewhere. Not thread-safe. The constructor raises CaptureError."""

    def __init__(self, path: Path, upright: bool = True):
        """upright: turn frames as the file states; otherwise they stay as they are stored."""
        self.path, self._upright = path, upright
        self._starts = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._answers = bytearray()
        self._memory = _shared_memory()
        self._shared: mmap.mmap | None = None
        weakref.finalize(self, os.close, self._memory)
        try:
            self.video = self._start()
        except _Ended as error:
            raise CaptureError(f"{path} is not a readable video: {error}. Convert it to H.264 in mp4.") from error

    def image(self, index: int, size: Size) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB of a frame, resampled to ``size``. Raises FrameError."""
        width, height = size
        try:
            if self._process is None:
                self._start()
            os.ftruncate(self._memory, width * height * 3)
            self._send(json.dumps({"index": index, "width": width, "height": height}))
            error = _as(self._answer(), _Answer).error
        except (_Ended, CaptureError) as ended:
            self._end()
            raise FrameError(f"Frame {index} of {self.path} cannot be decoded: {ended}.") from ended
        except BaseException:  # Ctrl-C: the answer would be taken for that of the next frame
            self._end()
            raise
        if error is not None:
            raise FrameError(error)
        if self._shared is None or len(self._shared) != width * height * 3:
            self._shared = mmap.mmap(self._memory, width * height * 3)
        return np.frombuffer(self._shared, np.uint8).reshape(height, width, 3).copy()

    def _start(self) -> Described:
        """Start the process. Raises _Ended, or CaptureError with what it says about the file."""
        self._starts += 1
        if self._starts > _MOST_STARTS:
            raise _Ended("the decoder has ended too often")
        paths = [path or os.getcwd() for path in sys.path]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OPENBLAS_NUM_THREADS": "1"}
        numbers = map(str, (self._memory, os.getpid(), int(self._upright)))
        arguments = [sys.executable, "-c", _CODE, os.fspath(self.path), *numbers]
        try:
            self._process = subprocess.Popen(
                arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0,
                pass_fds=(self._memory,), env=environment,
            )  # fmt: skip
        except OSError as error:
            raise _Ended(f"no process can be started ({error.strerror})") from error
        self._ending = weakref.finalize(self, _kill, self._process)
        self._answers = bytearray()
        said = self._answer()
        if (refused := _as(said, _Answer).error) is not None:
            self._end()
            raise CaptureError(refused)
        return _as(said, Described)

    def _send(self, line: str) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(line.encode() + b"\n")
        except OSError as error:
            raise _Ended(self._reason()) from error

    def _answer(self) -> bytes:
        """The next line that is not empty. Raises _Ended."""
        assert self._process is not None
        assert self._process.stdout is not None
        stream = self._process.stdout.fileno()
        poll = select.poll()
        poll.register(stream, select.POLLIN)
        deadline = time.monotonic() + SILENT_S
        searched = 0
        while True:
            while (end := self._answers.find(b"\n", searched)) >= 0:
                line, self._answers = bytes(self._answers[:end]), self._answers[end + 1 :]
                searched, deadline = 0, time.monotonic() + SILENT_S
                if line:
                    return line
            searched = len(self._answers)
            if not poll.poll(max(0.0, 1000 * (deadline - time.monotonic()))) or searched > _LONGEST_ANSWER:
                self._end()
                raise _Ended(f"the decoder makes no progress for {SILENT_S:.0f} s")
            chunk = os.read(stream, 1 << 20)
            if not chunk:
                raise _Ended(self._reason())
            self._answers += chunk

    def _reason(self) -> str:
        """Why the process has ended."""
        code = None
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = self._process.wait(5)
        self._end()
        return f"the decoder has ended ({f'signal {-code}' if code and code < 0 else f'exit {code}'})"

    def _end(self) -> None:
        if self._process is not None:
            self._ending()
            self._process = None


def _kill(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            stream.close()
    process.wait()


def _shared_memory() -> int:
    """The descriptor of memory that two processes share."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("freeocc3d-frame")
    with tempfile.TemporaryFile() as stream:
        return os.dup(stream.fileno())


def _as(line: bytes, kind: type[T]) -> T:
    try:
        return as_type(parse_json(line), kind)
    except InvalidDocument as error:
        raise _Ended("the decoder gives no answer that can be read") from error
