"""Dense depth of a scan's posed frames by multi-view stereo, for captures that have none."""

from __future__ import annotations

import functools
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ...arrays import read_arrays
from ...capture import read_ahead
from ...capture.base import Capture
from ...errors import ConfigError, FrameError, TrackingError
from ...progress import Progress
from ...registry import require_positive
from ...types import Frame, Intrinsics
from . import depth_network
from .consistency import DepthImage, confirmed
from .multi_view import completed, measured
from .neighbours import APART, Chosen, neighbours
from .photo_consistency import View
from .scan_planes import ScanPlane, scan_planes, snapped

__all__ = ["Options", "Scan", "StereoDepth", "View", "depth_map"]

_AT_ONCE = 16  # frames
_SCAN_PLANES = 60  # of the whole scan, at most
_FILES_KEPT = 128  # in memory: images and depths of the frames around the one in work
_STORED: dict[str, dict[str, tuple[str, int]]] = {
    "view": {"grey": ("u", 2), "T_world_cam": ("f", 2), "size": ("i", 1), "camera": ("f", 1)},
    "guess": {"inverse": ("f", 2)},
    **{stage: {"inverse": ("f", 2), "sigma": ("f", 2)} for stage in ("measured", "completed", "depth")},
}
_SAME_DEPTH = 0.01  # relative: up to it views agree, whatever their standard deviations
_LOOKING_THROUGH = 0.5  # views that contradict, over those that agree
_SAME_SURFACE = 0.02  # relative: beyond it, depths of adjacent pixels belong to different things


@dataclass(frozen=True)
class Options:
    """Depth for captures that have none, by multi-view stereo."""

    size: int = 640
    """Longer side of the depth images in pixels; frames get them enlarged to their own size."""
    neighbours: int = 4
    """Views that each frame is compared with."""
    planes: int = 12
    """Planes looked for around each frame, on which surfaces without texture are put; 0 = leave these empty, and do
    without the planes of the whole scan, too, which depths that cannot be told from them are moved to."""
    agreeing: int = 2
    """Views whose depth must confirm a pixel's, of twice as many as each frame is compared with."""
    vaguest: float = 0.025
    """Standard deviation over depth beyond which a pixel is left empty; small images need more."""
    network: str | None = None
    """ONNX network that guesses (inverse) depth from one image, fitted to each frame's stereo depth; it fills what
    stereo leaves empty."""
    device: str = "cpu"
    """Where stereo is computed: "cpu", or a CUDA device of torch's."""

    def __post_init__(self) -> None:
        require_positive(self, "neighbours", "agreeing", "vaguest")
        if self.size < 64:
            raise ConfigError(f"'size' must be at least 64 pixels, got {self.size}.")
        if self.planes < 0:
            raise ConfigError(f"'planes' must not be negative, got {self.planes}.")


class Scan(Protocol):
    """Poses and sparse points of a capture.

    T_world_cam: (N, 4, 4) float64, NaN where a frame has none.  points: (P, 3) float32 world.
    seen_frame, seen_point: (O,) int32, point ``seen_point[o]`` is seen in frame ``seen_frame[o]``.
    """

    @property
    def T_world_cam(self) -> NDArray[np.float64]: ...
    @property
    def points(self) -> NDArray[np.float32]: ...
    @property
    def seen_frame(self) -> NDArray[np.int32]: ...
    @property
    def seen_point(self) -> NDArray[np.int32]: ...


def depth_map(
    view: View, others: Sequence[View], near: float, far: float, options: Options
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth of one view from ``others``, which nothing has confirmed yet: (H, W) metres, 0 = none, and its standard
    deviation. The depth lies between ``near`` and ``far``; H, W are those of a view of ``options.size``."""
    small, sources = _shrunk(view, options.size), [_shrunk(other, options.size) for other in others]
    depth = measured(small, sources, sources, near, far, options.device)
    depth = completed(small, sources, depth, [], options.planes, options.device)
    return _metres(depth.inverse, depth.sigma)


class StereoDepth:
    """Depth of a scan's frames, one file a frame and stage in ``folder``: what is there is not computed again."""

    def __init__(self, folder: Path, options: Options):
        self.folder, self.options = folder, options
        self._lock = threading.Lock()
        self._planes: list[ScanPlane] = []
        self._read: OrderedDict[Path, dict[str, NDArray[np.generic]]] = OrderedDict()

    def compute(
        self,
        capture: Capture,
        scan: Scan,
        frames: Sequence[int],
        progress: Progress,
        prepared: Callable[[Frame], Frame] = lambda frame: frame,
    ) -> None:
        """Depth of those of ``frames`` that have a pose and partners.

        prepared: the frame as a pinhole camera sees it, should the capture's frames be distorted.
        Raises TrackingError if hardly any frame has others to be compared with; ModelError, about the network.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        T = np.full_like(scan.T_world_cam, np.nan)
        T[list(frames)] = scan.T_world_cam[list(frames)]
        posed = np.flatnonzero(np.isfinite(T).all(axis=(1, 2))).tolist()
        broken = self._decode(capture, posed, T, progress, prepared)
        T[broken] = np.nan
        seen, count = (T, scan.points, scan.seen_frame, scan.seen_point), self.options.neighbours
        chosen = neighbours(*seen, 2 * count)
        apart = neighbours(*seen, count + count // 2, APART).partners
        able = [frame for frame, partners in enumerate(chosen.partners) if len(partners)]
        if len(able) < 2:
            raise TrackingError(
                f"No depth can be had from the images of {capture.path}: no two of its frames see the same things from "
                "different places. Move the camera sideways, do not only turn it."
            )
        measure = functools.partial(self._measure, apart=apart)
        for stage, step in (("measured", measure), ("completed", self._complete), ("depth", self._confirm)):
            missing = [frame for frame in able if not self._path(stage, frame).exists()]
            progress.stage(f"stereo: {stage}", len(missing))
            if stage == "completed" and missing and self.options.planes:
                self._planes = scan_planes((self._depth("measured", frame) for frame in able), _SCAN_PLANES)
            for done, frame, depth in self._each(missing, functools.partial(step, chosen=chosen)):
                self._write(
                    stage, frame, inverse=depth.inverse.astype(np.float16), sigma=depth.sigma.astype(np.float16)
                )
                progress.advance(done)

    def depth(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """(H, W) depth in metres of a frame, 0 = none, and its standard deviation, at the size of ``prepared`` frames;
        None for a frame that has none. Raises MapError for a file that is damaged."""
        if not self._path("depth", index).exists():
            return None
        height, width = self._load("view", index)["size"].tolist()
        return _metres(*_enlarged(self._depth("depth", index), width, height))

    def _each(self, frames: Sequence[int], step: Callable[[int], DepthImage]) -> Iterator[tuple[int, int, DepthImage]]:
        """How many are done, a frame, and ``step`` of it. On a CPU each core has a frame of its own: their images are
        too small to be shared out."""
        workers = len(os.sched_getaffinity(0)) if self.options.device == "cpu" else 1
        threads = torch.get_num_threads()
        pool = ThreadPoolExecutor(workers, "stereo", initializer=torch.set_num_threads, initargs=(1,))
        try:
            for start in range(0, len(frames), _AT_ONCE):  # so that results do not pile up
                some = frames[start : start + _AT_ONCE]
                for done, (frame, depth) in enumerate(zip(some, pool.map(step, some), strict=True), start=start + 1):
                    yield done, frame, depth
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
        """Keep what is needed of each image; returns the frames that are broken."""
        path = self.options.network
        network = None if path is None else depth_network.load(Path(path).expanduser(), self.options.device)
        broken = []
        missing = [frame for frame in frames if not self._path("view", frame).exists()]
        progress.stage("stereo: images", len(missing))
        for done, (index, frame) in enumerate(read_ahead(capture, missing), start=1):
            if isinstance(frame, FrameError):
                broken.append(index)
                continue
            frame = prepared(frame)
            camera = frame.intrinsics
            small = _shrunk(View(frame.color, camera, T_world_cam[index]), self.options.size)
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

    def _measure(self, frame: int, chosen: Chosen, apart: list[NDArray[np.int64]]) -> DepthImage:
        others = [self._view(other) for other in chosen.partners[frame][: self.options.neighbours]]
        wide = [self._view(other) for other in apart[frame]] or others
        return measured(self._view(frame), others, wide, chosen.near[frame], chosen.far[frame], self.options.device)

    def _complete(self, frame: int, chosen: Chosen) -> DepthImage:
        options = self.options
        partners = chosen.partners[frame][: options.neighbours]
        others = [self._view(other) for other in partners]
        around = [self._depth("measured", other) for other in partners if len(chosen.partners[other])]
        own = self._depth("measured", frame)
        found = completed(self._view(frame), others, own, around, options.planes, options.device)
        return snapped(found, self._planes, float(own.sigma.min()))

    def _confirm(self, frame: int, chosen: Chosen) -> DepthImage:
        own, options = self._depth("completed", frame), self.options
        others = [self._depth("completed", i) for i in chosen.partners[frame] if len(chosen.partners[i])]
        found = confirmed(own, others, _SAME_DEPTH, options.device)
        keep = found.agreeing >= max(1, min(options.agreeing, len(others)))
        keep &= (found.through <= _LOOKING_THROUGH * found.agreeing) & (found.sigma < options.vaguest * found.inverse)
        inverse, sigma = (found.inverse * keep).cpu().numpy(), found.sigma.cpu().numpy()
        if options.network is not None:
            guess = self._load("guess", frame)["inverse"].astype(np.float32)
            inverse, sigma = depth_network.fused(inverse, sigma, guess)
        return DepthImage(inverse, sigma, own.camera, own.T_world_cam)

    def _view(self, frame: int) -> View:
        stored = self._load("view", frame)
        height, width = stored["size"].tolist()
        grey = stored["grey"].astype(np.float32) / np.float32(65535.0)
        camera = Intrinsics(width, height, *stored["camera"].tolist()).resized(grey.shape[1], grey.shape[0])
        return View(grey, camera, stored["T_world_cam"].astype(np.float64))

    def _depth(self, stage: str, frame: int) -> DepthImage:
        stored, view = self._load(stage, frame), self._view(frame)
        inverse, sigma = stored["inverse"].astype(np.float32), stored["sigma"].astype(np.float32)
        return DepthImage(inverse, sigma, view.intrinsics, view.T_world_cam)

    def _path(self, stage: str, frame: int) -> Path:
        return self.folder / f"{frame:06d}.{stage}.npz"

    def _write(self, stage: str, frame: int, **arrays: NDArray[np.generic]) -> None:
        path = self._path(stage, frame)
        temporary = path.with_suffix(".tmp.npz")
        np.savez(temporary, **arrays)  # type: ignore[arg-type]
        temporary.replace(path)

    def _load(self, stage: str, frame: int) -> dict[str, NDArray[np.generic]]:
        path = self._path(stage, frame)
        with self._lock:
            if path not in self._read:
                self._read[path] = read_arrays(path, _STORED[stage])
                if len(self._read) > _FILES_KEPT:
                    self._read.popitem(last=False)
            self._read.move_to_end(path)
            return self._read[path]


def _shrunk(view: View, size: int) -> View:
    """The view with a longer side of ``size`` pixels, or of fewer if it has fewer; both sides even."""
    camera = view.intrinsics
    by = min(1.0, size / max(camera.width, camera.height))
    return view.shrunk(2 * round(camera.width * by / 2), 2 * round(camera.height * by / 2))


def _enlarged(depth: DepthImage, width: int, height: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Inverse depths and their sigma at another size: between pixels of one surface they are interpolated."""
    nearest = cv2.resize(depth.inverse, (width, height), interpolation=cv2.INTER_NEAREST)
    between = cv2.resize(depth.inverse, (width, height), interpolation=cv2.INTER_LINEAR)
    smooth = (nearest > 0) & (np.abs(between - nearest) < _SAME_SURFACE * nearest)
    sigma = cv2.resize(depth.sigma, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.where(smooth, between, nearest), np.asarray(sigma, np.float32)


def _metres(
    inverse: NDArray[np.float32], sigma: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth and its standard deviation from those of inverse depth."""
    depth_m = np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    return depth_m, np.asarray(sigma * depth_m**2, np.float32)
