"""One small map for all tests of commands."""

from pathlib import Path

import pytest
from command_line import SMALL, run
from made_once import make_once


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def make(path: Path) -> None:
        done = run("reconstruct", "builtin:room", "-o", path, *SMALL)
        assert "8 with a pose" in done.stdout

    return make_once(tmp_path_factory, "room-of-commands", make)
