"""Dense depth of a scan's posed frames by multi-view stereo, for captures without depth."""

from __future__ import annotations

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ..capture import read_ahead
from ..capture.base import Capture
from ..core.arrays import read_arrays, write_arrays
from ..core.errors import FrameError, MapError, TrackingError
from ..core.progress import Progress
from ..core.threads import count_threads
from ..core.types import Frame, Intrinsics
from ..settings.stages import StereoOptions as Options
from ..tracking.base import PosedPoints
from . import depth_network
from .building_planes import Layout
from .cross_view_check import DepthImage
from .photo_consistency import StereoView
from .plane_detection import detect_layout
from .scan_points import ScanPoints, confirm_points, merge_points
from .surface_depth import prefer_own_depth, render_surface_depth
from .view_depth import measure_depth
from .view_selection import APART, SelectedViews, select_partners
from .watertight_surface import WatertightSurface, build_surface

__all__ = ["Options", "StereoDepth", "StereoView"]

_AT_ONCE = 16  # frames
_FILES_KEPT = 64  # kept in memory: images and depths around the current frame
_STORED: dict[str, dict[str, tuple[str, int]]] = {
    "view": {"grey": ("u", 2), "T_world_cam": ("f", 2), "size": ("i", 1), "camera": ("f", 1)},
    "guess": {"inverse": ("f", 2)},
    **{stage: {"inverse": ("f", 2), "sigma": ("f", 2)} for stage in ("measured", "depth")},
}
_SURFACE = {"vertices": ("f", 2), "sigma_m": ("f", 1), "triangles": ("i", 2), "cell_m": ("f", 1)}
_EACH_WAY = 8  # pixel step of the depths that give the typical depth of the scan
_LEAST_POINTS = 100
_Result = TypeVar("_Result")
_SAME_SURFACE = 0.02  # largest relative depth difference of adjacent pixels of one surface


class StereoDepth:
    """Depth maps of a scan's frames. Each frame measures depth, other frames confirm its points, all confirmed points
    give the surface of the scan, and the surface gives the depth of each frame. ``folder`` holds one file per frame and
    stage, and the surface; existing files are not computed again."""

    def __init__(self, folder: Path, options: Options):
        self.folder, self.options = folder, options
        self._lock = threading.Lock()
        self._read: OrderedDict[Path, dict[str, NDArray[np.generic]]] = OrderedDict()

    def compute(
        self,
        capture: Capture,
        scan: PosedPoints,
        frames: Sequence[int],
        progress: Progress,
        prepared: Callable[[Frame], Frame] = lambda frame: frame,
    ) -> None:
        """Compute the depth of those ``frames`` that have a pose and partner views.

        prepared: undistorts a frame to a pinhole camera.
        Raises TrackingError if too few frames have partner views, or hardly any point is confirmed; ModelError for the
        network.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        T = np.full_like(scan.T_world_cam, np.nan)
        T[list(frames)] = scan.T_world_cam[list(frames)]
        posed = np.flatnonzero(np.isfinite(T).all(axis=(1, 2))).tolist()
        broken = self._decode(capture, posed, T, progress, prepared)
        T[broken] = np.nan
        seen, count = (T, scan.points, scan.seen_frame, scan.seen_point), self.options.neighbors
        chosen = select_partners(*seen, 2 * count)
        apart = select_partners(*seen, count + count // 2, APART).partners
        able = [frame for frame, partners in enumerate(chosen.partners) if len(partners)]
        if len(able) < 2:
            raise TrackingError(
                f"The images of {capture.path} give no depth: no two frames see the same objects from different "
                "places. Move the camera sideways; do not only turn it."
            )
        self._compute("measured", able, functools.partial(self._measure, chosen=chosen, apart=apart), progress)
        if not (self._surface_path.exists() and self._layout_path.exists()):
            points = self._points(able, chosen, progress)
            if len(points.points) < _LEAST_POINTS:
                raise TrackingError(
                    f"The images of {capture.path} give no depth: hardly any point has the same depth in several "
                    "images. The images may be blurred or show bare surfaces, or the poses may be wrong."
                )
            surface = build_surface(points, T[able, :3, 3])
            self._save(surface, detect_layout(points, T[able, :3, 3], surface.normals()))
        self._compute(
            "depth", able, functools.partial(self._render, surface=self._surface(), planes=self._layout()), progress
        )

    def depth(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """(H, W) depth of a frame, meters, 0 = none, and its standard deviation, meters, at the size of ``prepared``
        frames; None for a frame without depth. Raises MapError for a damaged file."""
        if not self._path("depth", index).exists():
            return None
        height, width = self._load("view", index)["size"].tolist()
        return _meters(*_enlarged(self._depth("depth", index), width, height))

    def _compute(
        self, stage: str, frames: Sequence[int], step: Callable[[int], DepthImage], progress: Progress
    ) -> None:
        """Run ``step`` for the frames without a file of the stage."""
        missing = [frame for frame in frames if not self._path(stage, frame).exists()]
        progress.stage(f"stereo: {stage}", len(missing))
        for done, frame, depth in self._each(missing, step):
            self._write(stage, frame, inverse=depth.inverse.astype(np.float16), sigma=depth.sigma.astype(np.float16))
            progress.advance(done)

    def _each(self, frames: Sequence[int], step: Callable[[int], _Result]) -> Iterator[tuple[int, int, _Result]]:
        """Yield the number of finished frames, a frame, and the result of ``step`` for it. On a CPU, each core works on
        its own frame, because the images are too small to divide."""
        workers = count_threads() if self.options.device == "cpu" else 1
        threads = torch.get_num_threads()
        pool = ThreadPoolExecutor(workers, "stereo", initializer=torch.set_num_threads, initargs=(1,))
        try:
            for start in range(0, len(frames), _AT_ONCE):  # limits the waiting results
                some = frames[start : start + _AT_ONCE]
                for done, (frame, found) in enumerate(zip(some, pool.map(step, some), strict=True), start=start + 1):
                    yield done, frame, found
        finally:
            pool.shutdown(cancel_futures=True)
            torch.set_num_threads(threads)

    def _decode(
        self,
        capture: Capture,
        frames: Sequence[int],
        T_world_cam: NDArray[np.float64],
        progress: Progress,
        prepared: Callable[[Frame], Frame],
    ) -> list[int]:
        """Store what the stages need of each image. Returns the broken frames."""
        path = self.options.network
        network = (
            None if path is None else depth_network.load_depth_network(Path(path).expanduser(), self.options.device)
        )
        broken = []
        missing = [frame for frame in frames if not self._path("view", frame).exists()]
        progress.stage("stereo: images", len(missing))
        for done, (index, frame) in enumerate(read_ahead(capture, missing), start=1):
            if isinstance(frame, FrameError):
                broken.append(index)
                continue
            frame = prepared(frame)
            camera = frame.intrinsics
            small = _shrunk(StereoView(frame.color, camera, T_world_cam[index]), self.options.size)
            if network is not None:
                guess = network(frame.color, small.intrinsics.width, small.intrinsics.height)
                self._write("guess", index, inverse=guess)
            self._write(
                "view", index, grey=np.rint(small.color * 65535.0).astype(np.uint16), T_world_cam=small.T_world_cam,
                size=np.array((camera.height, camera.width)),
                camera=np.array((camera.fx, camera.fy, camera.cx, camera.cy)),
            )  # fmt: skip
            progress.advance(done)
        return broken

    def _measure(self, frame: int, chosen: SelectedViews, apart: list[NDArray[np.int64]]) -> DepthImage:
        others = [self._view(other) for other in chosen.partners[frame][: self.options.neighbors]]
        wide = [self._view(other) for other in apart[frame]] or others
        return measure_depth(
            self._view(frame), others, wide, chosen.near[frame], chosen.far[frame], self.options.device
        )

    def _points(self, frames: Sequence[int], chosen: SelectedViews, progress: Progress) -> ScanPoints:
        def confirmed(frame: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            others = [self._depth("measured", i) for i in chosen.partners[frame] if len(chosen.partners[i])]
            agreeing = max(1, min(self.options.agreeing, len(others)))
            return confirm_points(self._depth("measured", frame), others, agreeing, self.options.device)

        def advancing() -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
            for done, _, points in self._each(frames, confirmed):
                progress.advance(done)
                yield points

        progress.stage("stereo: surface", len(frames))
        some = [self._depth("measured", frame).inverse[::_EACH_WAY, ::_EACH_WAY] for frame in frames]
        inverse = np.concatenate([image[image > 0] for image in some])
        return merge_points(advancing(), 1.0 / float(np.median(inverse)) if len(inverse) else 1.0)

    def _render(self, frame: int, surface: WatertightSurface, planes: Layout) -> DepthImage:
        view = self._view(frame)
        depth = render_surface_depth(surface, planes, view.intrinsics, view.T_world_cam)
        depth = prefer_own_depth(self._depth("measured", frame), depth)
        if self.options.network is None:
            return depth
        guess = self._load("guess", frame)["inverse"].astype(np.float32)
        inverse, sigma = depth_network.fuse_guess(depth.inverse, depth.sigma, guess)
        return DepthImage(inverse, sigma, view.intrinsics, view.T_world_cam)

    @property
    def _surface_path(self) -> Path:
        return self.folder / "surface.npz"

    @property
    def _layout_path(self) -> Path:
        return self.folder / "layout.npz"

    def _surface(self) -> WatertightSurface:
        stored = read_arrays(self._surface_path, _SURFACE)
        vertices, triangles = stored["vertices"], stored["triangles"]
        shapes = tuple(stored[name].shape for name in ("vertices", "sigma_m", "triangles", "cell_m"))
        if shapes != ((len(vertices), 3), (len(vertices),), (len(triangles), 3), (1,)):
            raise MapError(
                f"{self._surface_path} is damaged: its arrays have inconsistent sizes. Delete it and resume."
            )
        if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
            raise MapError(
                f"{self._surface_path} is damaged: its triangles have missing corners. Delete it and resume."
            )
        return WatertightSurface(vertices, stored["sigma_m"], triangles, float(stored["cell_m"][0]))

    def _layout(self) -> Layout:
        path = self._layout_path
        try:
            return Layout.from_arrays(read_arrays(path, Layout.EXPECTED))
        except ValueError as error:
            raise MapError(f"{path} is damaged: it holds {error}.") from error

    def _save(self, surface: WatertightSurface, planes: Layout) -> None:
        """Save both files."""
        write_arrays(self._layout_path, planes.to_arrays())
        arrays = {name: getattr(surface, name) for name in ("vertices", "sigma_m", "triangles")}
        write_arrays(self._surface_path, {**arrays, "cell_m": np.array([surface.cell_m])})

    def _view(self, frame: int) -> StereoView:
        stored = self._load("view", frame)
        height, width = stored["size"].tolist()
        gray = stored["grey"].astype(np.float32) / np.float32(65535.0)
        camera = Intrinsics(width, height, *stored["camera"].tolist()).resized(gray.shape[1], gray.shape[0])
        return StereoView(gray, camera, stored["T_world_cam"].astype(np.float64))

    def _depth(self, stage: str, frame: int) -> DepthImage:
        stored, view = self._load(stage, frame), self._view(frame)
        inverse, sigma = stored["inverse"].astype(np.float32), stored["sigma"].astype(np.float32)
        return DepthImage(inverse, sigma, view.intrinsics, view.T_world_cam)

    def _path(self, stage: str, frame: int) -> Path:
        return self.folder / f"{frame:06d}.{stage}.npz"

    def _write(self, stage: str, frame: int, **arrays: NDArray[np.generic]) -> None:
        write_arrays(self._path(stage, frame), arrays)

    def _load(self, stage: str, frame: int) -> dict[str, NDArray[np.generic]]:
        path = self._path(stage, frame)
        with self._lock:
            if path not in self._read:
                self._read[path] = read_arrays(path, _STORED[stage])
                if len(self._read) > _FILES_KEPT:
                    self._read.popitem(last=False)
            self._read.move_to_end(path)
            return self._read[path]


def _shrunk(view: StereoView, size: int) -> StereoView:
    """The view reduced to at most ``size`` pixels on the longer side; both sides are even."""
    camera = view.intrinsics
    by = min(1.0, size / max(camera.width, camera.height))
    return view.shrunk(2 * round(camera.width * by / 2), 2 * round(camera.height * by / 2))


def _enlarged(depth: DepthImage, width: int, height: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Inverse depth and sigma at another size. Depth is interpolated only between pixels of one surface."""
    nearest = cv2.resize(depth.inverse, (width, height), interpolation=cv2.INTER_NEAREST)
    between = cv2.resize(depth.inverse, (width, height), interpolation=cv2.INTER_LINEAR)
    smooth = (nearest > 0) & (np.abs(between - nearest) < _SAME_SURFACE * nearest)
    sigma = cv2.resize(depth.sigma, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.where(smooth, between, nearest), np.asarray(sigma, np.float32)


def _meters(
    inverse: NDArray[np.float32], sigma: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Convert inverse depth and its standard deviation to depth and its standard deviation, meters."""
    depth_m = np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    return depth_m, np.asarray(sigma * depth_m**2, np.float32)
