"""Commands end with a sentence, whatever a service has done to the standard streams, the language and the folder."""

from __future__ import annotations

import shlex
import subprocess
import sys

import pytest

LIST = f"{shlex.quote(sys.executable)} -m freeocc3d.cli list"
MISSING = f"{shlex.quote(sys.executable)} -m freeocc3d.cli info /nowhere"
PLAIN = "env LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0"
SENTENCE = "freeocc3d: The map folder /nowhere does not exist.\n"


@pytest.mark.parametrize(
    ("line", "status", "errors"),
    [
        (f"{LIST} > /dev/full", 1, "freeocc3d: The answer cannot be written: No space left on device.\n"),
        (f"{LIST} >&-", 0, ""),
        (f"{LIST} <&- >&- 2>&-", 0, ""),
        (f"{LIST} | head -1 > /dev/null", 0, ""),
        (f"{PLAIN} {LIST} > /dev/null", 0, ""),
        (f"env -u TERM -u HOME {LIST} > /dev/null", 0, ""),
        (f"{MISSING} <&-", 1, SENTENCE),
        (f"{MISSING} 2>&-", 1, ""),
        (f"{MISSING} 2> /dev/full", 1, ""),
        (f"{PLAIN} {MISSING}", 1, SENTENCE),
    ],
)
def test_a_command_ends_with_a_sentence(line: str, status: int, errors: str) -> None:
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (status, errors)
    if line.startswith(MISSING):
        assert done.stdout == ""


def test_nothing_takes_the_number_of_a_closed_stream(tmp_path) -> None:
    """Libraries print to stderr by its number: into the map, if a file of the map has this number."""
    code = (
        "from freeocc3d.cli.main import _prepare_streams; _prepare_streams(); import os, sys\n"
        f"file = open({str(tmp_path / 'file')!r}, 'w')\n"
        "os.write(2, b'noise'); print('noise', file=sys.stderr); file.close()"
    )
    line = f"{shlex.quote(sys.executable)} -c {shlex.quote(code)} <&- >&- 2>&-"
    assert subprocess.run(["bash", "-c", line], timeout=60, check=False).returncode == 0
    assert (tmp_path / "file").read_text() == ""


def test_a_removed_folder_is_no_traceback(tmp_path) -> None:
    line = f"mkdir {tmp_path}/gone && cd {tmp_path}/gone && rmdir {tmp_path}/gone && {LIST} > /dev/null && {MISSING}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr.splitlines()[-1:]) == (1, [SENTENCE.strip()])
