"""The examples of CONTRIBUTING.md are complete: they work as an installed package of another author."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_captures import camera_matrix, color_image, depth_image

ROOT = Path(__file__).parents[2]
PACKAGE = "example_backends"
LONGEST = 40


def examples() -> dict[str, str]:
    """File name -> content of each titled block."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    return dict(re.findall(r'```python title="([\w.]+)"\n(.*?)```', text, re.DOTALL))


def entry_points() -> str:
    """What an installed package says of its entry points, from the block of pyproject.toml."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    block = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)[0]
    return re.sub(r'\[project\.entry-points\."(.*?)"\]', r"[\1]", block).replace('"', "")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds the package as an installer leaves it."""
    folder = tmp_path_factory.mktemp("site")
    (folder / PACKAGE).mkdir()
    (folder / PACKAGE / "__init__.py").touch()
    for name, content in examples().items():
        (folder / PACKAGE / name).write_text(content, encoding="utf-8")
    facts = folder / f"{PACKAGE}-1.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {PACKAGE}\nVersion: 1.0\n", encoding="utf-8")
    (facts / "entry_points.txt").write_text(entry_points(), encoding="utf-8")
    return folder


def run(installed: Path, *commands: list[str]) -> str:
    """What the commands print, run one after the other in one new process, in which the package is installed."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(installed), str(ROOT)])}
    program = "import json, sys\nfrom freeocc3d.cli.main import app\nfor words in json.loads(sys.argv[1]):\n"
    program += "    app(args=words, prog_name='freeocc3d', standalone_mode=False)"
    command = [sys.executable, "-c", program, json.dumps(commands)]
    done = subprocess.run(command, cwd=installed, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def write_scan(folder: Path, frames: int = 6) -> Path:
    folder.mkdir()
    K = camera_matrix()
    np.savetxt(folder / "camera.txt", [[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]])
    for index in range(frames):
        np.save(folder / f"{index}.color.npy", color_image(index))
        np.save(folder / f"{index}.depth.npy", depth_image(index) / 1000)
    return folder


@pytest.mark.parametrize("name", examples())
def test_an_example_is_short(name: str) -> None:
    assert len(examples()[name].splitlines()) <= LONGEST


def test_there_is_an_example_of_each_kind() -> None:
    groups = re.findall(r"\[freeocc3d\.(\w+)\]\n(\w+) = \w+\.(\w+)", entry_points())
    assert [kind for kind, *_ in groups] == ["readers", "trackers", "encoders", "exporters"]
    assert {f"{module}.py" for *_, module in groups} == set(examples())


def test_the_examples_are_listed(installed: Path) -> None:
    listed = run(installed, ["list"])
    for name in ("numpy_frames", "tripod", "brightness", "csv"):
        assert re.search(rf"^ +{name} ", listed, re.MULTILINE), name


def test_the_examples_map_a_scan(installed: Path, tmp_path: Path) -> None:
    scan, made, table = write_scan(tmp_path / "scan"), tmp_path / "map", tmp_path / "map.csv"
    chosen = ["--set", "tracking.backend=tripod", "--set", "language.encoder=brightness", "--set", "fitting.passes=0"]
    printed = run(
        installed,
        ["reconstruct", str(scan), "-o", str(made), *chosen],
        ["query", str(made), "bright"],
        ["export", str(made), "--format", "csv", "-o", str(table), "--set", "least=0.6"],
    )
    assert "6 with a pose" in printed
    assert "bright: 1 region" in printed
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    assert len(rows) > 0
    assert rows[:, 3].min() >= 0.6
