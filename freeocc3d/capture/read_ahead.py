"""Decodes frames on a second thread while the first thread processes earlier frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor

from ..core.errors import FrameError
from ..core.types import Frame
from .base import Capture


def read_ahead(capture: Capture, indices: Iterable[int], depth: int = 4) -> Generator[tuple[int, Frame | FrameError]]:
    """Yield ``(index, frame)`` in the order of ``indices``, or ``(index, error)`` for a broken frame.

    depth: number of frames to decode ahead; memory holds these and the one in use.
    Raises any other error of the capture at the frame concerned. If the generator ends early, by ``break`` or an
    exception, the thread finishes its current frame and ends.
    """
    pending: deque[Future[tuple[int, Frame | FrameError]]] = deque()
    executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="read-ahead")
    try:
        for index in indices:
            pending.append(executor.submit(_read, capture, index))
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
