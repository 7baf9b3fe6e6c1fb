"""One small map for all tests of commands."""

from pathlib import Path

import pytest
from command_line import SMALL, run


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cli") / "room"
    done = run("reconstruct", "builtin:room", "-o", path, *SMALL)
    assert "8 with a pose" in done.stdout
    return path
