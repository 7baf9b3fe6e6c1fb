"""One capture's runs, and the folders where they leave results for each other."""

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
        """The capture's name in the rows."""
        return capture_name(self.capture)

    def map(self, variant: str) -> Path:
        """The folder of a variant's map."""
        return self.folder / variant

    def poses(self, source: str) -> Path:
        """The file where a run leaves its poses for others."""
        return self.folder / f"{source}.npz"
