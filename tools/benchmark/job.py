"""One capture's runs, and where they leave what others read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from .folders import capture_name


@dataclass(frozen=True)
class Job:
    """One capture's runs. frames: the first N, None = all.  folder: for maps and trajectories."""

    capture: Path
    frames: int | None
    folder: Path

    @property
    def name(self) -> str:
        """What rows call the capture."""
        return capture_name(self.capture)

    def map(self, variant: str) -> Path:
        """The folder of a variant's map."""
        return self.folder / variant

    def poses(self, source: str) -> Path:
        """Where a run leaves its poses for others."""
        return self.folder / f"{source}.npz"
