"""Figures of poses from color alone, ours and those of pycolmap's own pipeline at its defaults, on the same images."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from freeocc3d.core.progress import Progress

from .figures import Figures, tabulate

STAGES = ("features", "matching", "mapping", "adjustment")
LONG, STRIDES = 1000, (5, 3)
"""The first stride is for captures with this many frames or more, the second for others."""


def measure_poses_from_color(capture: str) -> Figures:
    """Share of the images that are placed, ATE after Sim(3), wall and CPU seconds: ours and pycolmap's, with one camera
    for all images. Depth is not read; the true poses only score."""
    import numpy as np

    from freeocc3d.capture import open_capture
    from freeocc3d.capture.base import Options
    from freeocc3d.tracking.sfm.structure_from_motion import Recipe, reconstruct_poses

    opened = open_capture(capture, Options(depth=False))
    frames = range(0, len(opened), choose_stride(len(opened)))
    true = np.stack([_or_none(opened.pose(index)) for index in frames])
    with tempfile.TemporaryDirectory() as folder:
        watch = _Watch()
        found = reconstruct_poses(opened, frames, Path(folder), Recipe(frames=len(frames)), watch)
        watch.stage("")
        seconds, cpu_seconds = watch.seconds, time.process_time() - watch.began
    lens = found.lens
    ours = {
        **_scores(found.T_world_cam[list(frames)], true),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "points": len(found.points),
        "focal_px": lens.camera.fx,
        "distortion": list(lens.distortion),
    }
    return {"frames": len(frames), "ours": ours, "pycolmap": _defaults(opened, frames, true)}


def choose_stride(frames: int) -> int:
    """The stride of the frames that are used when only color is read, for a capture with this many frames."""
    return STRIDES[frames < LONG]


class _Watch(Progress):
    """A ``Progress`` that adds up the seconds of each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.began = time.process_time()
        self._stage, self._since = "", time.perf_counter()

    def stage(self, name: str, total: int | None = None) -> None:
        now = time.perf_counter()
        if self._stage:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = name, now


def _defaults(capture: Any, frames: range, true: Any) -> Figures:
    """pycolmap's pipeline for images in order: extract_features, match_sequential, incremental_mapping."""
    import cv2
    import numpy as np
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "images").mkdir()
        for index in frames:
            cv2.imwrite(str(folder / "images" / f"{index:06d}.png"), capture[index].color[:, :, ::-1])
        database, watch = folder / "database.db", _Watch()
        watch.stage("features")
        pycolmap.extract_features(database, folder / "images", camera_mode=pycolmap.CameraMode.SINGLE)
        watch.stage("matching")
        pycolmap.match_sequential(database)
        watch.stage("mapping")
        models = pycolmap.incremental_mapping(database, folder / "images", folder)
        watch.stage("")
        cpu_seconds = time.process_time() - watch.began
        T_world_cam = np.full((len(frames), 4, 4), np.nan)
        if models:
            largest = max(models.values(), key=lambda model: model.num_reg_images())
            for image in largest.images.values():
                if image.has_pose:
                    pose = np.vstack((image.cam_from_world().inverse().matrix(), (0, 0, 0, 1)))
                    T_world_cam[frames.index(int(Path(image.name).stem))] = pose
    return {**_scores(T_world_cam, true), "seconds": watch.seconds, "cpu_seconds": cpu_seconds}


def _or_none(pose: Any) -> Any:
    import numpy as np

    return np.full((4, 4), np.nan) if pose is None else pose


def _scores(T_world_cam: Any, true: Any) -> Figures:
    """Share of the (N, 4, 4) poses that are placed, and ATE of the camera centers against the true poses after
    Sim(3)."""
    import numpy as np

    from freeocc3d.core.transforms import umeyama

    placed = np.isfinite(T_world_cam).all(axis=(1, 2))
    both = placed & np.isfinite(true).all(axis=(1, 2))
    if both.sum() < 3:
        return {"placed": float(placed.mean()), "ate_rmse_m": None}
    estimated, expected = T_world_cam[both][:, :3, 3], true[both][:, :3, 3]
    scale, R, t = umeyama(estimated, expected, with_scale=True)
    errors = scale * estimated @ R.T + t - expected
    return {"placed": float(placed.mean()), "ate_rmse_m": float(np.sqrt((errors**2).sum(axis=1).mean()))}


def tabulate_poses_from_color(rows: list[Figures]) -> list[str]:
    """A table, two lines for each capture."""
    table = []
    for row in rows:
        if "error" in row:
            table.append([row["capture"], f"not available, {row['error']}", *["–"] * (len(STAGES) + 4)])
            continue
        for who in ("ours", "pycolmap"):
            one = row[who]
            ate = "–" if one["ate_rmse_m"] is None else f"{100 * one['ate_rmse_m']:.2f}"
            stages = [f"{one['seconds'][stage]:.0f}" if stage in one["seconds"] else "–" for stage in STAGES]
            total = f"{sum(one['seconds'].values()):.0f}"
            cells = [f"{100 * one['placed']:.1f}", ate, *stages, total, f"{one['cpu_seconds']:.0f}"]
            table.append([row["capture"], f"{who}, {row['frames']} images", *cells])
    return tabulate(
        [
            "capture",
            "poses from color",
            "placed %",
            "ATE cm",
            *(f"{stage} s" for stage in STAGES),
            "wall s",
            "CPU s",
        ],
        table,
    )
