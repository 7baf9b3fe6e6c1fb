"""Sound captures of every format: a few tiny frames in each."""

from __future__ import annotations

from pathlib import Path

FRAMES = 4


def write_scans(folder: Path) -> None:
    """Write each format into a folder of its own. A capture that is a file is alone there."""
    from scans import plane_scan
    from written_captures import WRITTEN

    for name, written in WRITTEN.items():
        size = written.size if written.reader == "azure_kinect" else (32, 24)
        scan = plane_scan(FRAMES, size, unsure=written.confidence is not None)
        place = folder / name.replace(" ", "_").replace(",", "")
        place.mkdir()
        written.write(place, scan)
