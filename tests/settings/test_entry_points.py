"""Backends that another installed package adds: listed without being imported, loaded, their options checked."""

import subprocess
import sys
from pathlib import Path

import pytest

PLUGIN = '''"""Writes how many voxels are occupied."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from freeocc3d.export.export_frames import BoxOptions
from freeocc3d.settings.option_types import PositiveInt

REQUIRES: tuple[str, ...] = ()


class Options(BoxOptions, frozen=True):
    """How the number is written."""

    digits: PositiveInt = 6
    """Digits of the number."""


def write(scan_map: Any, path: Path, options: Options) -> None:
    path.write_text(f"{len(scan_map.occupancy.colors):0{options.digits}d}")
'''


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder for installed packages that holds a package with one exporter and one encoder that cannot be read."""
    package = tmp_path / "voxel_counter"
    package.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('the package was imported')\n")
    (tmp_path / "voxel_count_exporter.py").write_text(PLUGIN)
    info = tmp_path / "voxel_counter-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: voxel-counter\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[freeocc3d.exporters]\ncount = voxel_count_exporter\nply = voxel_count_exporter\n"
        "gone = no_such_module_at_all\n\n[freeocc3d.encoders]\nother = voxel_counter.encoder\n"
    )
    (package / "encoder.py").write_text('"""An encoder of another package."""\nREQUIRES = ("no_such_package",)\n')
    return tmp_path


def run(site: Path, code: str) -> str:
    prelude = f"import sys\nsys.path.insert(0, {str(site)!r})\nfrom freeocc3d.settings import registry\n"
    done = subprocess.run([sys.executable, "-c", prelude + code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_is_listed_without_being_imported(site: Path) -> None:
    said = run(
        site,
        "found = registry.backends('export')\n"
        "print(found['count'].summary, [option.name for option in found['count'].options], 'gone' in found)\n"
        "print(found['ply'].module, registry.backends('language.encoders')['other'].missing)\n"
        "assert not {'voxel_counter', 'voxel_count_exporter', 'freeocc3d.export'} & set(sys.modules)",
    )
    assert "Writes how many voxels are occupied. ['box', 'digits'] False" in said
    assert "freeocc3d.export.ply ('no_such_package',)" in said


def test_it_is_loaded_and_its_options_are_checked(site: Path, tmp_path: Path) -> None:
    said = run(
        site,
        "from types import SimpleNamespace\n"
        "from freeocc3d.core.errors import ConfigError, DependencyError\n"
        "from freeocc3d.export import export_map\n"
        "scan_map = SimpleNamespace(occupancy=SimpleNamespace(colors=[0] * 12))\n"
        f"export_map(scan_map, 'count', {str(tmp_path / 'count.txt')!r}, {{'digits': 4}})\n"
        "for options in ({'digits': 0}, {'digit': 1}, {'box': [1, 0, 0, 0, 1, 1]}):\n"
        "    try:\n        export_map(scan_map, 'count', 'x', options)\n"
        "    except ConfigError as error:\n        print(error)\n"
        "try:\n    registry.load('language.encoders', 'other')\n"
        "except DependencyError as error:\n    print(error)",
    )
    assert (tmp_path / "count.txt").read_text() == "0012"
    lines = said.splitlines()
    assert lines[0] == "'count.digits' must be at least 1, got 0."
    assert lines[1] == "Unknown key 'count.digit' (did you mean 'digits'?)."
    assert lines[2].startswith("'count.box' takes a lower and an upper corner")
    assert lines[3] == "The encoder 'other' needs no_such_package: run pip install no_such_package."


def test_the_command_lists_it(site: Path) -> None:
    said = run(site, "from freeocc3d.cli.main import main\nmain(['list', 'exporters'])")
    assert "digits = 6  (a whole number of at least 1) Digits of the number." in said
