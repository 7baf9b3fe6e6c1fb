"""A map that is being made, or that nobody has begun to make: shown by the snapshots of its run, then by the map."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import MapError
from ...query.scan_map import Map
from ...storage.live_snapshot import SNAPSHOT, Snapshot, read_snapshot, watch
from ...storage.output_folder import follow_link
from ...storage.run_lock import is_running
from .packets import compress, pack
from .scene_arrays import Arrays, describe_voxels
from .shown_map import ShownMap


class LiveMap(ShownMap):
    """A map folder that need not be there yet. Raises MapError for a path that no map can have."""

    def __init__(self, path: Path):
        path = follow_link(path if path.name else path.resolve())
        if not path.name:
            raise MapError(f"'{path}' cannot be the name of a map folder.")
        super().__init__(path, check=False)
        self._work = path.with_name(path.name + ".partial")

    @property
    def version(self) -> str:
        """Names what is shown now; tells the run that somebody watches."""
        if is_running(self._work):
            watch(self._work)
            try:
                return f"making-{(self._work / SNAPSHOT).stat().st_mtime_ns}"
            except OSError:
                return "begun"
        return super().version if self.path.is_dir() else "waiting"

    @property
    def capture(self) -> str:
        """The name of the capture; empty while the map is being made."""
        return "" if self._in_the_making else super().capture

    def scene(self) -> bytes:
        """The packet of the snapshot, or of the map if it is made, compressed."""
        if not self._in_the_making:
            return super().scene()
        version = self.version
        snapshot = read_snapshot(self._work) if is_running(self._work) else None
        return compress(pack(*_describe(self.path.name, version, snapshot)))

    @property
    def _in_the_making(self) -> bool:
        return is_running(self._work) or not self.path.is_dir()

    def _current(self) -> Map:
        if self._in_the_making:
            raise MapError(f"The map {self.path} is still being made: ask when it is done.")
        return super()._current()


def _describe(name: str, version: str, snapshot: Snapshot | None) -> tuple[dict[str, Any], Arrays]:
    """Returns document and arrays of a packet as ``describe_scene`` gives them, with what there is."""
    if snapshot is None:
        told = "Waiting for a run to begin" if version == "waiting" else "Waiting for the first picture of the run"
        snapshot = Snapshot(told, False, True, np.eye(4), 0.08, np.zeros(3), np.zeros((0, 3), np.int32),
                            np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.float32))  # fmt: skip
    ones, zeros = np.ones(len(snapshot.voxels), np.int32), np.zeros(len(snapshot.voxels), np.uint16)
    low = snapshot.voxels.min(axis=0).astype(np.int64) if len(ones) else np.zeros(3, np.int64)
    meta, arrays = describe_voxels(snapshot.voxels, ones, low, snapshot.origin, snapshot.voxel_size)
    arrays |= {
        "colors": snapshot.colors, "probability": np.full(len(ones), 255, np.uint8), "hits": zeros,
        "seen_through": zeros, "path": snapshot.path, "T_map_cam": np.zeros((0, 16), np.float32),
        "cameras": np.zeros((0, 6), np.float32), "means": np.zeros((0, 3), np.float32),
        "scales": np.zeros((0, 3), np.float32), "quats_wxyz": np.zeros((0, 4), np.int8),
        "opacities": np.zeros(0, np.uint8), "splat_colors": np.zeros((0, 3), np.uint8),
    }  # fmt: skip
    count = len(snapshot.path)
    return {
        "title": name, "capture": "", "metric": snapshot.metric, "T_view_map": snapshot.T_view_map.tolist(),
        "keyframes": [], "frames": {"posed": count, "all": count}, "gaussians": {"drawn": 0, "all": 0}, "encoder": "",
        "voxels": meta, "classes": [], "version": version, "upright": snapshot.upright,
        "live": f"{snapshot.stage}, {time.strftime('%H:%M:%S')}",
    }, arrays  # fmt: skip
