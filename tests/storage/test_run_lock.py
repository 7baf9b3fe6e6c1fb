"""One run at a time writes a map; a lock ends with its process."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from freeocc3d.core.errors import MapError
from freeocc3d.storage.run_lock import LOCK, RunLock

HOLD = "import sys, time; from pathlib import Path; from freeocc3d.storage.run_lock import RunLock; "
HOLD += "held = RunLock(Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"


def test_a_second_lock_says_who_holds_the_first_and_since_when(tmp_path: Path) -> None:
    first = RunLock(tmp_path / "work")
    with pytest.raises(MapError, match=rf"in use: another run \(process {os.getpid()} on .*, since 20\d\d-"):
        RunLock(tmp_path / "work")
    first.release()
    first.release()
    assert list((tmp_path / "work").iterdir()) == []
    RunLock(tmp_path / "work").release()


def test_a_lock_is_released_when_its_process_is_killed(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        with pytest.raises(MapError, match=f"process {process.pid} on"):
            RunLock(tmp_path)
        process.send_signal(signal.SIGKILL)
    assert (tmp_path / LOCK).is_file()
    RunLock(tmp_path).release()


def test_a_lock_follows_the_folder_that_is_renamed(tmp_path: Path) -> None:
    lock = RunLock(tmp_path / "work")
    (tmp_path / "work").rename(tmp_path / "map")
    other = RunLock(tmp_path / "work")
    lock.folder = tmp_path / "map"
    lock.release()
    assert not (tmp_path / "map" / LOCK).exists()
    assert (tmp_path / "work" / LOCK).exists()
    other.release()


def test_what_is_in_the_place_of_the_lock_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / LOCK).symlink_to(tmp_path / "precious")
    (tmp_path / "pipe").mkdir()
    os.mkfifo(tmp_path / "pipe" / LOCK)
    for name in ("link", "pipe"):
        with pytest.raises(OSError, match=r"."):
            RunLock(tmp_path / name)
    assert (tmp_path / "precious").read_text() == "mine"


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_used_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    held = RunLock(tmp_path / "work")
    assert (tmp_path / "work" / LOCK).is_file()
    held.release()
    assert list((tmp_path / "work").iterdir()) == []
    number = errno.EIO
    with pytest.raises(OSError, match=os.strerror(errno.EIO)):
        RunLock(tmp_path / "work")


def test_the_holder_of_an_unreadable_lock_is_another_run(tmp_path: Path) -> None:
    held = RunLock(tmp_path)
    (tmp_path / LOCK).write_bytes(b"\xff{")
    with pytest.raises(MapError, match="in use: another run writes"):
        RunLock(tmp_path)
    held.release()
