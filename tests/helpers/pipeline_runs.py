"""Shared by tests of whole runs: a short scan of the built-in room, and the content of a map's folder."""

from __future__ import annotations

from pathlib import Path

import yaml

from freeocc3d.core.warnings import Notice, read_notices

ROOM = {
    "capture": {"synthetic": {"frames": 240, "width": 160, "height": 120}, "stop": 24, "color_focal": 1.0},
    "fitting": {"passes": 1},
}
"""Without the calibration of color, which would take half of the time."""

ONE_PASS = {"fitting": {"passes": 1}}


def notices(made) -> list[Notice]:
    """The warnings of a map's report."""
    return read_notices(made.report["warnings"])


def content(folder: Path) -> dict[str, bytes]:
    """What must be equal in two maps of one capture with one configuration: every file, but for the report, which
    states times, and what the manifest says of the report."""
    files = listing(folder)
    del files["report.json"]
    manifest = yaml.safe_load(files["map.yaml"])
    for stated in ("files", "checksums"):
        del manifest[stated]["report.json"]
    return {**files, "map.yaml": repr(manifest).encode()}


def listing(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, with what is in it."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
