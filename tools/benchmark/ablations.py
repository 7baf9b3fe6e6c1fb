"""The ablations of ``configs/ablations``: configurations that are mapped and scored by name.

The first line of a file says what the variant is. ``# table:`` names its table of the paper. ``# needs:`` says what is
missing where this version of freeocc3d refuses its options; a trial run of the check finds that out.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import yaml

from .folders import REPOSITORY

FOLDER = REPOSITORY / "configs" / "ablations"

OURS = "rgbd"
"""The variant whose poses the peers ``ours_*`` use, and whose map is queried."""

UNFITTED, MONO = "rgbd_no_fitting", "mono"
TRUE_POSES, TRUE_CLASSES = "rgbd_true_poses", "rgbd_true_poses_closed_set"
"""Ablations that others are compared with."""

_TRY = """
import sys
from pathlib import Path
from freeocc3d.pipeline import checks
from freeocc3d.settings import config
from freeocc3d.core.errors import FreeOccError
for path in sys.argv[1:]:
    try:
        checks.check(config.load(Path(path)))
        print("")
    except FreeOccError as error:
        print(error)
"""


@dataclass(frozen=True)
class Ablation:
    """title: what it is.  table: of the paper.  lacking: why it cannot run, one sentence; empty if it can. color_alone:
    whether it works without depth."""

    name: str
    title: str
    table: str
    path: Path
    lacking: str
    color_alone: bool


def list_ablations() -> list[str]:
    """The names of all ablations."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def read_ablations() -> dict[str, Ablation]:
    """Every ablation by name, in the order of the names."""
    paths = sorted(FOLDER.glob("*.yaml"))
    command = [sys.executable, "-c", _TRY, *map(str, paths)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    return {path.stem: _read_ablation(path, refused) for path, refused in zip(paths, said, strict=True)}


def _read_ablation(path: Path, refused: str) -> Ablation:
    text = path.read_text(encoding="utf-8")
    comments = [line[1:].strip() for line in text.splitlines() if line.startswith("#")]
    facts = dict(line.split(": ", 1) for line in comments[1:] if line.startswith(("table: ", "needs: ")))
    lacking = f"needs {facts['needs']}" if refused and "needs" in facts else refused
    capture = (yaml.safe_load(text) or {}).get("capture") or {}
    return Ablation(path.stem, comments[0], facts.get("table", ""), path, lacking, capture.get("depth") is False)
