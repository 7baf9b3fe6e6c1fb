"""Messages are one line that can be printed and stored, whatever the names of files hold."""

import os

from freeocc3d.core.errors import CaptureError, FreeOccError, printable


def test_a_message_is_printable() -> None:
    name = os.fsdecode(b"caf\xe9\n\x1b[31m.png")
    error = CaptureError(f"{name} – “missing”.")
    assert str(error) == r"caf\udce9\n\x1b[31m.png – “missing”."
    assert str(error).encode()
    assert f"{error}" == str(error) == printable(str(error))
    assert str(FreeOccError()) == ""
