"""A stopped command says so, whichever signal stops it and whatever it is doing; a second signal ends it at once."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading

import pytest

from freeocc3d.cli import stopping
from freeocc3d.cli.stopping import Stopping


def stopped(work: str, *signals: signal.Signals, ignored: bool = False) -> subprocess.CompletedProcess:
    """Run a command that does ``work`` after it was sent the signals by itself."""
    code = (
        "import ctypes, os, signal, sys, time\n"
        + ("signal.signal(signal.SIGHUP, signal.SIG_IGN)\n" if ignored else "")
        + "from freeocc3d.cli import main, stopping\n"
        "stopping.GRACE_S = 0.2\n"
        "@main.app.command()\n"
        "def work():\n"
        f"    send = lambda: [{', '.join(f'os.kill(os.getpid(), {int(number)})' for number in signals)}]\n"
        f"    {work}\n"
        "    print('done')\n"
        "main.main(['work'])\n"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGINT, 1), (signal.SIGTERM, 143), (signal.SIGHUP, 129)],
    ids=lambda value: str(value),
)
def test_a_stopped_command_says_so(number: signal.Signals, status: int) -> None:
    done = stopped("send(); time.sleep(50)", number)
    assert (done.returncode, done.stderr, done.stdout) == (status, "freeocc3d: Stopped.\n", "")


def test_a_second_signal_ends_at_once() -> None:
    done = stopped("try:\n        send()\n    finally:\n        time.sleep(50)", signal.SIGTERM, signal.SIGTERM)
    assert (done.returncode, done.stdout) == (143, "")


def test_a_command_in_a_library_ends_after_a_while() -> None:
    """A C function that goes on after a signal: Python's handler waits until it returns."""
    code = "lock = (ctypes.c_char * 64)(); c = ctypes.CDLL(None); c.pthread_mutex_lock(lock)"
    forever = "threading.Timer(0.1, send).start(); c.pthread_mutex_lock(lock)"
    done = stopped(f"import threading; {code}; {forever}", signal.SIGTERM)
    assert (done.returncode, done.stdout) == (143, "")


def test_an_ignored_signal_stays_ignored() -> None:
    done = stopped("send()", signal.SIGHUP, ignored=True)
    assert (done.returncode, done.stdout) == (0, "done\n")


def test_handlers_are_put_back() -> None:
    before = {number: signal.getsignal(number) for number in stopping._SIGNALS}
    with Stopping() as first:
        assert signal.getsignal(signal.SIGTERM) == first._stop
    assert {number: signal.getsignal(number) for number in stopping._SIGNALS} == before
    assert first.status == 1


def test_other_threads_leave_signals_alone() -> None:
    def enter() -> None:
        with Stopping():
            seen.append(signal.getsignal(signal.SIGTERM))

    seen: list[object] = []
    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGTERM)]
