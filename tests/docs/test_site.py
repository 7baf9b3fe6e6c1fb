"""The site builds without a warning, with working links, and needs no network."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mkdocs")

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_command_and_option_is_in_the_reference(site: Path) -> None:
    command_line = (site / "reference" / "command-line.html").read_text(encoding="utf-8")
    assert all(f"freeocc3d {name}" in command_line for name in ("reconstruct", "query", "models export", "info"))
    options = (site / "reference" / "options.html").read_text(encoding="utf-8")
    assert all(name in options for name in ("voxel_size", "keyframe_overlap", "no_return"))
    map_format = (site / "reference" / "map-format.html").read_text(encoding="utf-8")
    assert "voxel_size_m" in map_format
    assert "MANIFEST_KEYS" not in map_format
    occupancy = (site / "reference" / "python" / "occupancy.html").read_text(encoding="utf-8")
    assert "freeocc3d.occupancy.splat.bin_gaussians" in occupancy


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe)[^>]*\bsrc="(https?:[^"]*)"', text)
        loaded += re.findall(r'<link[^>]*rel="(?:stylesheet|preconnect)"[^>]*href="(https?:[^"]*)"', text)
        assert not loaded, page
