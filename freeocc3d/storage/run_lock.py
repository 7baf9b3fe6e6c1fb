"""The lock of a work folder: one process at a time writes a map. The system releases it when its process ends, however
that ends, so that no lock is ever stale. Where the file system has no locks, runs are not kept apart."""

from __future__ import annotations

import contextlib
import datetime
import errno
import fcntl
import json
import os
import socket
from pathlib import Path

import msgspec

from ..core.errors import MapError
from ..core.regular_files import check_regular

LOCK = "lock"
"""Name of the file in the work folder. It says who holds the lock, and since when."""

_LONGEST = 4096


class _Holder(msgspec.Struct):
    process: int
    host: str
    since: str


def is_running(folder: Path) -> bool:
    """Whether a run that works in a folder is alive, by what its lock file says; one of another computer counts as
    alive. Takes no lock, which a run that begins would find taken."""
    try:
        with (folder / LOCK).open("rb") as file:
            holder = msgspec.json.decode(file.read(_LONGEST), type=_Holder)
        if holder.host == socket.gethostname():
            os.kill(holder.process, 0)
    except PermissionError:
        return True
    except (OSError, OverflowError, msgspec.DecodeError):
        return False
    return True


class RunLock:
    """An exclusive lock on a folder, held until ``release`` or the end of the process."""

    def __init__(self, folder: Path):
        """Make the folder if there is none, and lock it. Raises MapError if another run holds the lock, OSError."""
        self.folder = folder
        while True:
            folder.mkdir(parents=True, exist_ok=True)
            self._descriptor = self._locked(folder / LOCK)
            if self._descriptor >= 0:
                return

    def _locked(self, path: Path) -> int:
        """A descriptor that holds the lock; -1 if the folder was renamed meanwhile, so that this locked nothing."""
        with contextlib.suppress(FileNotFoundError):
            check_regular(path)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW, 0o644)
        except FileNotFoundError:
            return -1
        try:
            _flock(descriptor)
            if _same_file(path, descriptor):
                said = {"process": os.getpid(), "host": socket.gethostname(), "since": _now()}
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, json.dumps(said).encode(), 0)
                return descriptor
        except BlockingIOError as error:
            holder = _holder(os.pread(descriptor, _LONGEST, 0))
            os.close(descriptor)
            raise MapError(
                f"{self.folder} is in use: {holder} writes this map. Wait until it is done, or choose another folder."
            ) from error
        except OSError:
            os.close(descriptor)
            raise
        os.close(descriptor)
        return -1

    def release(self) -> None:
        """Remove the lock's file, wherever the folder is now, and let others lock. Does nothing the second time."""
        if self._descriptor < 0:
            return
        with contextlib.suppress(OSError):
            if _same_file(self.folder / LOCK, self._descriptor):
                (self.folder / LOCK).unlink()
        os.close(self._descriptor)
        self._descriptor = -1


def _flock(descriptor: int) -> None:
    """Lock an open file; nothing on a file system without locks, as some of networks are. Raises OSError."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP):
            raise


def _same_file(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _holder(content: bytes) -> str:
    """Who holds the lock, in words."""
    try:
        said = msgspec.json.decode(content, type=_Holder)
    except msgspec.MsgspecError:  # it is just being written
        return "another run"
    return f"another run (process {said.process} on {said.host}, since {said.since})"


def _now() -> str:
    return datetime.datetime.now().astimezone().isoformat(" ", "seconds")
