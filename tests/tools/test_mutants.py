"""The tool that makes small changes: what it changes, which tests it runs, and what it says became of the change."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from mutation import trial
from mutation.changes import find_sites, make_change, sample_changes
from mutation.project import Project

TOOL = Path(__file__).parents[2] / "tools" / "mutants.py"

PART = '''"""A part."""


def clamp(value, least):
    """The larger one."""
    if value < least:
        return least
    return value


def unseen(value):
    return value * 3
'''
TEST = "from pack.room.part import clamp, unseen\n\ndef test_clamp():\n    assert clamp(1, 2) == 2 and unseen\n"
EQUIVALENT = "room/part || value < least || value <= least || Equal values are the same.\n"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A package of one module, which a test covers in part."""
    files = {
        "pack/__init__.py": "",
        "pack/room/__init__.py": "",
        "pack/room/part.py": PART,
        "pack/room/user.py": "from .part import clamp  # numba\n",
        "pack/other/__init__.py": "from ..room.part import clamp\n",
        "tests/room/test_part.py": TEST,
        "tests/room/test_rest.py": "from pack.other import clamp\n\ndef test_rest():\n    assert clamp\n",
        "tests/other/test_far.py": "from pack.room import part\n",
        "tools/equivalent.txt": EQUIVALENT,
        "setup.cfg": "[tool:pytest]\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def changes_of(source: str) -> set[str]:
    """Every change of a source, as text."""
    sites = find_sites(ast.parse(source))
    numbers = [f"{number}.{which}" for number, site in enumerate(sites) for which in range(len(site.replacements))]
    return {make_change(source, number).source.strip() for number in numbers}


@pytest.mark.parametrize(
    ("source", "changed"),
    [
        ("x = a + b", {"x = a - b"}),
        ("x = a ** b", {"x = a * b"}),
        ("x -= a", {"x += a"}),
        ("x = a < b", {"x = a <= b", "x = a >= b"}),
        ("x = a != b", {"x = a == b"}),
        ("x = a and b", {"x = a or b"}),
        ("x = not a", {"x = a"}),
        ("x = -a", {"x = a"}),
        ("x = 2", {"x = 3", "x = -2"}),
        ("x = 0.25", {"x = 0.5", "x = -0.25"}),
        ("x = a[2]", {"x = a[3]"}),
        ("x = f(a, axis=1)", {"x = f(a, axis=2)"}),
        ("x = a[:n]", {"x = a[1:n]", "x = a[:n - 1]"}),
        ("x = np.minimum(a, b)", {"x = np.maximum(a, b)"}),
        ("x = any(a)", {"x = all(a)"}),
        ("x = f(a, b)", {"x = f(b, a)"}),
    ],
)
def test_each_kind_of_change(source: str, changed: set[str]) -> None:
    assert changes_of(source) == changed


@pytest.mark.parametrize(
    "source",
    [
        '"""Says 1 + 1."""',
        "x: Grid[3]",
        "X = Annotated[int, Meta(ge=1)]",
        "def f(a: Grid[3]) -> Grid[2]:\n    pass",
        "@njit(cache=2)\ndef f():\n    pass",
        "raise ValueError(1 + 1)",
        "x = f'{a + b}'",
        "log.warning('%d', a + b)",
        "x = '%d' % a",
        "x = True",
        "x = f(a, a)",
        "x = np.zeros(np.int32, np.uint8)",
    ],
)
def test_what_says_nothing_about_behavior_stays(source: str) -> None:
    assert not changes_of(source)


def test_a_sample_follows_from_its_seed_and_grows() -> None:
    few, many = (sample_changes(PART, "a seed", count) for count in (2, 4))
    assert few == many[:2]
    assert len({change.number.split(".")[0] for change in many}) == len(many)
    assert [change.number for change in many] != [change.number for change in sample_changes(PART, "another", 4)]


def test_own_tests_and_stale_kernels(project: Path) -> None:
    found = Project(project, "pack")
    assert [path.name for path in found.own_tests("room/part")] == ["test_part.py", "test_rest.py"]
    assert [path.name for path in found.own_tests("room/user")] == []
    assert found.kernels_with("room/part") == {"room/part", "room/user"}
    (project / "tests/room/test_part.py").unlink()
    (project / "tests/room/test_rest.py").unlink()
    assert [path.name for path in Project(project, "pack").own_tests("room/part")] == ["test_far.py"]


def run(project: Path, *arguments: str) -> tuple[int, str]:
    places = ["--root", project, "--package", "pack", "--equivalent", "tools/equivalent.txt"]
    command = [sys.executable, str(TOOL), *map(str, places), "--modules", "room/part", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert not done.stderr
    return done.returncode, done.stdout


def test_a_change_is_noticed_survives_or_changes_nothing(project: Path) -> None:
    names = [f"room/part#{number}" for number in ("0.0", "0.1", "1.0")]
    code, said = run(project, "--only", *names, "--json", str(project / "found.json"))
    found = {one["after"]: one["outcome"] for one in json.loads((project / "found.json").read_text())}
    assert found == {
        "value <= least": "equivalent",
        "value >= least": "noticed",
        "return value / 3": "survived",
    }
    assert re.search(r"^room/part +3 +1 +1 +1 +50%$", said, re.MULTILINE)
    assert code == 1  # less than 90 %
    assert (project / "pack/room/part.py").read_text() == PART


def test_a_change_that_never_ends_is_noticed(tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    (copy / "test_endless.py").write_text("def test():\n    while True:\n        pass\n")
    outcome = trial.wait(trial.start(copy, ["test_endless.py"], limit_s=1))
    assert not outcome.passed
    assert 0.9 < outcome.cpu_s < 8


def test_a_test_that_fails_by_itself_is_told_and_left_out(project: Path) -> None:
    (project / "tests/room/test_part.py").write_text("def test():\n    assert 0\n")
    command = [sys.executable, str(TOOL), "--root", str(project), "--package", "pack", "--only", "room/part#0.1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert "tests/room/test_part.py fails without any change and is left out" in done.stderr
    assert "survived" in done.stdout.splitlines()[1], "the other test of the room sees nothing"
    assert done.returncode == 1
