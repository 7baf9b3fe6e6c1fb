"""Looks at maps in Chromium without a GPU: seconds until a map is drawn and until a word lights up, and memory.

Beside the map stands a building of a million voxels: copies of the map in a square, with one set of keyframes.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .figures import Figures, Line
from .processes import COMMAND, PartFailed

VOXELS = 1_000_000
SWITCHES = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
"""Of a Chromium that draws with the processor and asks nothing of the network."""

_DRAWN = "document.documentElement.dataset.ready && freeocc3d.scene.frames > 0"
_ANSWERED = "freeocc3d.results.length > 0 && freeocc3d.scene.frames > {frames}"


def measure_viewer(map_path: str) -> Figures:
    """Seconds, bytes of memory and bytes of the page, for the map and for a building of ``VOXELS``."""
    from freeocc3d.query.scan_map import load_map
    from freeocc3d.viewer.browser.single_file import make_whole_page

    loaded = load_map(map_path)
    word = loaded.vocabulary[int(np.bincount(loaded.labels()[loaded.labels() > 0]).argmax()) - 1]
    with tempfile.TemporaryDirectory() as folder:
        building = Path(folder) / "building"
        make_building(loaded, building, -(-VOXELS // len(loaded.occupancy.colors)))
        return {
            "page_bytes": len(make_whole_page(loaded)),
            "map": look_at(Path(map_path), word),
            "building": look_at(building, word),
        }


def make_building(scan_map: Any, output: Path, rooms: int) -> None:
    """Writes a map of copies of a map's voxels, side by side."""
    from freeocc3d.storage.work_folder import WorkFolder
    from freeocc3d.storage.writer import MapParts, write_changed_map

    room, row = scan_map.occupancy, int(np.ceil(np.sqrt(rooms)))
    extent = np.ptp(room.keys, axis=0) + 1
    shifts = np.array([(k % row, k // row, 0) for k in range(rooms)]) * extent
    repeated = {name: np.concatenate([getattr(room, name)] * rooms)
                for name in ("probability", "free", "hits", "state", "colors", "levels")}  # fmt: skip
    occupancy = room.replace(
        keys=np.concatenate([room.keys + shift for shift in shifts]).astype(np.int32),
        features=np.concatenate([np.asarray(room.features)] * rooms),
        **repeated,
    )
    with WorkFolder.made_of(scan_map.path, output, False) as work:
        parts = MapParts(
            facts=scan_map.manifest, settings=scan_map.settings, report=lambda: scan_map.report, occupancy=occupancy,
            codec=room.features.codec, features=scan_map.gaussian_features, gaussians=scan_map.gaussians,
        )  # fmt: skip
        write_changed_map(scan_map, work, output, parts)


def look_at(map_path: Path, word: str) -> Figures:
    """Seconds from the command to a drawn map and from the word to a drawn answer, and the browser's memory."""
    from playwright.sync_api import sync_playwright

    start = time.perf_counter()
    with serve(map_path) as address, sync_playwright() as playwright, tempfile.TemporaryDirectory() as profile:
        served = time.perf_counter() - start
        context = playwright.chromium.launch_persistent_context(
            profile,
            executable_path=chromium(),
            args=list(SWITCHES),
            viewport={"width": 1280, "height": 800},
            bypass_csp=True,
        )
        page = context.pages[0]
        opened = time.perf_counter()
        page.goto(address)
        page.wait_for_function(_DRAWN, timeout=120_000)
        loaded = time.perf_counter() - opened
        page.wait_for_timeout(3000)
        frames = page.evaluate("freeocc3d.scene.frames")
        page.fill("input[name=words]", word)
        asked = time.perf_counter()
        page.press("input[name=words]", "Enter")
        page.wait_for_function("freeocc3d.results.length > 0", timeout=60_000)
        listed = time.perf_counter() - asked
        page.wait_for_function(_ANSWERED.format(frames=frames), timeout=60_000)
        lit = time.perf_counter() - asked
        figures = {
            "server_seconds": served, "load_seconds": loaded, "listed_seconds": listed, "lit_seconds": lit,
            "frame_ms": page.evaluate("freeocc3d.scene.fullMs"), "memory": _memory(profile),
            "voxels": page.evaluate("freeocc3d.meta.voxels.count"),
        }  # fmt: skip
        context.close()
    return figures


@contextlib.contextmanager
def serve(map_path: Path, *more: str) -> Iterator[str]:
    """Runs ``freeocc3d view`` and yields its address."""
    command = [*COMMAND, "view", str(map_path), *more, "--no-browser", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            yield server.stdout.readline().strip()
        finally:
            server.terminate()


def chromium() -> str:
    """The browser's program. Raises PartFailed if there is none."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if found := shutil.which(name):
            return found
    raise PartFailed("there is no Chromium: sudo apt-get install chromium")


def _memory(profile: str) -> int:
    """Bytes of the largest process of the browser with this profile, shared pages counted in part."""
    largest = 0
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if "chrom" in (folder / "exe").readlink().name and profile in _ancestry(folder):
                rollup = (folder / "smaps_rollup").read_text()
                largest = max(largest, 1024 * int(rollup.split("Pss:", 1)[1].split()[0]))
    return largest


def _ancestry(folder: Path) -> str:
    """The command lines of a process and its ancestors."""
    told = ""
    while folder.name not in ("0", "1"):
        told += (folder / "cmdline").read_text()
        parent = (folder / "stat").read_text().rsplit(")", 1)[1].split()[1]
        folder = Path("/proc") / parent
    return told


def viewer_lines(figures: Figures) -> list[Line]:
    """Rows of a table: what, measured, asked."""
    lines: list[Line] = [("the map as one page", f"{figures['page_bytes'] / 1e6:.1f} MB", "≤ 15 MB")]
    for name, seconds, memory, answer in (("map", "", "", ""), ("building", "≤ 10 s", "≤ 1.5 GB", "≤ 1 s")):
        own = figures[name]
        total = own["server_seconds"] + own["load_seconds"]
        lines += [
            (f"{own['voxels']:,} voxels in Chromium without a GPU, from the command until drawn",
             f"{total:.1f} s (server {own['server_seconds']:.1f}, page {own['load_seconds']:.1f})", seconds),
            ("  memory of its largest process", f"{own['memory'] / 1e9:.2f} GB", memory),
            ("  from Enter to the list of regions; to the whole picture",
             f"{own['listed_seconds']:.2f} s; {own['lit_seconds']:.2f} s", answer),
            ("  drawing all of it once", f"{own['frame_ms']:.0f} ms", ""),
        ]  # fmt: skip
    return lines
