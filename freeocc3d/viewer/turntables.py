"""Writes a video that goes once around a map: voxels, and the Gaussians beside them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.atomic_files import write_whole
from ..core.errors import ExportError
from ..core.progress import Progress
from ..query.scan_map import Map
from .map_colorings import MapColoring
from .map_pictures import BAR, frame_views, has_gaussians, map_title
from .map_scenes import build_scene, open_panels
from .view_cameras import aim_around

SIZE = 1280, 720
"""Width and height of the video, pixels; even, as H.264 needs them."""

_CODECS = {"libx264": {"crf": "22", "preset": "medium"}, "mpeg4": {"qscale": "4", "flags": "+qscale"}}
_BT709 = 1


def write_turntable(
    scan_map: Map,
    coloring: MapColoring,
    path: Path,
    seconds: float = 10.0,
    fps: int = 24,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> None:
    """Writes an MP4 with H.264, or MPEG-4 where FFmpeg lacks an encoder for that. It is whole or not there.

    Raises ExportError: another ending than .mp4, an unwritable target, no encoder; DependencyError: no off-screen
    rendering.
    """
    check_video_name(path)
    images = _images(scan_map, coloring, max(2, round(seconds * fps)), progress or Progress())
    write_whole(path, lambda target: _encode(images, target, fps), overwrite)


def check_video_name(path: Path) -> None:
    """Raises ExportError."""
    if path.suffix.lower() != ".mp4":
        raise ExportError(f"Videos are written as MP4: use the name {path.with_suffix('.mp4')} in place of {path}.")


def _images(scan_map: Map, coloring: MapColoring, count: int, progress: Progress) -> Iterator[NDArray[np.uint8]]:
    scene = build_scene(scan_map, coloring)
    both = has_gaussians(scan_map)
    size = SIZE[0] // (1 + both), SIZE[1] - 2 * BAR
    title = map_title(scan_map)
    progress.stage("video", count)
    with open_panels(scan_map, scene, size, both) as draw:
        for number, camera in enumerate(aim_around(scene.drawn, size, count), 1):
            yield frame_views(draw(camera), title, coloring.legend)
            progress.advance(number)


def _encode(images: Iterator[NDArray[np.uint8]], path: Path, fps: int) -> None:
    """Raises OSError, ExportError."""
    import av

    codec = next((name for name in _CODECS if _can_encode(name)), None)
    if codec is None:
        raise ExportError(
            "Videos need FFmpeg with an encoder for H.264 or MPEG-4: run pip install --force-reinstall av."
        )
    try:
        with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
            stream: Any = container.add_stream(codec, rate=fps, options=_CODECS[codec])
            stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
            stream.codec_context.colorspace = stream.codec_context.color_primaries = _BT709
            stream.codec_context.color_trc = _BT709
            for image in images:
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
                container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))
            container.mux(stream.encode())
    except av.error.FFmpegError as error:
        if isinstance(error, OSError):
            raise
        raise ExportError(f"Cannot encode {path.name} with {codec}: {error}.") from error


def _can_encode(name: str) -> bool:
    import av

    try:
        return bool(av.codec.Codec(name, "w").is_encoder)
    except ValueError:  # also what av raises for a codec that it does not know
        return False
