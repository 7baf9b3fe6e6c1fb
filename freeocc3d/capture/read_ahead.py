"""Decodes frames on a second thread while the first thread processes earlier frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from ..core.errors import FrameError
from ..core.types import Frame
from .base import Capture

T = TypeVar("T")


def read_ahead(capture: Capture, indices: Iterable[int], depth: int = 4) -> Generator[tuple[int, Frame | FrameError]]:
    """Yield ``(index, frame)`` in the order of ``indices``, or ``(index, error)`` for a broken frame.

    depth: number of frames to decode ahead; memory holds these and the one in use.
    Raises any other error of the capture at the frame concerned.
    """
    return call_ahead(lambda index: _read(capture, index), indices, depth)


def call_ahead(read: Callable[[int], T], indices: Iterable[int], depth: int = 4) -> Generator[T]:
    """Yield ``read(index)`` in the order of ``indices``, called up to ``depth`` indices ahead on a second thread.

    Raises what ``read`` raises, at the index concerned. If the generator ends early, by ``break`` or an exception, the
    thread finishes its current call and ends.
    """
    pending: deque[Future[T]] = deque()
    executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="read-ahead")
    try:
        for index in indices:
            pending.append(executor.submit(read, index))
            if len(pending) > depth:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _read(capture: Capture, index: int) -> tuple[int, Frame | FrameError]:
    try:
        return index, capture[index]
    except FrameError as error:
        return index, error.with_traceback(None)  # the traceback would keep the bytes of the file in memory
