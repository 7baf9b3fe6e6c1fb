"""Ctrl-C, SIGTERM and SIGHUP end a command in the same way: with a sentence, and with what is done so far kept."""

from __future__ import annotations

import os
import select
import signal
import threading
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

GRACE_S = 8.0
"""Longest time until a stopped command has ended, seconds. Docker waits 10 s before it kills."""


class Stopping:
    """While it is entered, the first signal raises KeyboardInterrupt in the main thread. A second signal ends the
    process at once, and so does ``GRACE_S`` later a thread of its own: Python handles no signal while a library
    computes. Signals that are ignored (``nohup``, ``&`` in a script) stay ignored; elsewhere than in the main thread it
    does nothing."""

    def __init__(self) -> None:
        self._stopped: int | None = None
        self._before: dict[int, Any] = {}

    @property
    def status(self) -> int:
        """Exit status of a failed command: 1, or 128 plus the number of the signal, as shells say it, if it was stopped
        otherwise than by Ctrl-C."""
        return 1 if self._stopped in (None, signal.SIGINT) else 128 + self._stopped

    def __enter__(self) -> Stopping:
        if threading.current_thread() is not threading.main_thread():
            return self
        for number in _SIGNALS:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                self._before[number] = signal.signal(number, self._stop)
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, name="signals", daemon=True).start()
        return self

    def __exit__(self, *raised: object) -> None:
        if self._before:
            signal.set_wakeup_fd(self._wakeup)
            for number, handler in self._before.items():
                signal.signal(number, handler)
            os.close(self._write)  # ends the thread
            self._before = {}

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self._stopped is None:
            self._stopped = number
            raise KeyboardInterrupt

    def _watch(self) -> None:
        """Reads the numbers of signals as they come."""
        first = None
        while first is None or select.select([self._read], [], [], GRACE_S)[0]:
            number = os.read(self._read, 1)
            if not number:
                os.close(self._read)
                return
            if number[0] not in self._before:
                continue
            if first is not None:
                break
            first = number[0]
        os._exit(128 + first)
