"""Tiny videos for the tests; each frame shows its own number."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

SIZE = 96, 64
"""Width and height as coded."""

_BITS = 8


def numbered_image(number: int, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """(H, W, 3) RGB: a red top left corner, a blue bottom right one, and the number as 8 bright or dark columns."""
    width, height = size
    image = np.full((height, width, 3), 60, np.uint8)
    image[: height // 4, : width // 4] = (220, 30, 30)
    image[-(height // 4) :, -(width // 4) :] = (30, 30, 220)
    for bit in range(_BITS):
        bright = 230 if number >> bit & 1 else 20
        image[height * 3 // 8 : height * 5 // 8, bit * width // _BITS : (bit + 1) * width // _BITS] = bright
    return image


def number_of(image: NDArray[np.uint8]) -> int:
    """The number that an upright image of any size shows."""
    height, width = image.shape[:2]
    columns = (np.arange(_BITS) + 0.5) * width / _BITS
    return int(sum((int(image[height // 2, int(column), 1]) > 125) << bit for bit, column in enumerate(columns)))


def write_video(
    path: Path,
    count: int = 60,
    times_ms: Sequence[int] | None = None,
    codec: str = "libx264",
    rotation: int = 0,
    size: tuple[int, int] = SIZE,
    gop: int = 12,
    tags: dict[str, str] | None = None,
    options: dict[str, str] | None = None,
    form: str | None = None,
) -> Path:
    """times_ms: when each frame is shown, by default 30 times a second.  rotation: degrees, counterclockwise, by which
    a player has to turn the frames; what is coded is turned the other way, so that played frames are upright.
    options: of the encoder.  form: FFmpeg's name of the container, by default that of the suffix; H.264 alone without
    one."""
    times = [round(1000 * n / 30) for n in range(count)] if times_ms is None else times_ms
    turns = rotation // 90 % 4
    form = form or (None if path.suffix else "h264")
    muxing = {"movflags": "use_metadata_tags"} if tags else {}
    with av.open(str(path), "w", format=form, options=muxing) as container:
        container.metadata.update(tags or {})
        stream = container.add_stream(codec, rate=30, options=options or {})
        stream.width, stream.height = size if turns % 2 == 0 else size[::-1]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        counts = form in ("h264", "hevc") or path.suffix in (".avi", ".mpg", ".h264", ".hevc")  # frames, at one rate
        unit = Fraction(1, 30) if counts else Fraction(1, 1000)
        stream.time_base = stream.codec_context.time_base = unit
        stream.gop_size = gop
        stream.codec_context.bit_rate = 2_000_000
        if turns:
            stream.set_display_rotation(rotation)
        for number, time in enumerate(times):
            image = np.ascontiguousarray(np.rot90(numbered_image(number, size), -turns))
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = (number if counts else time), unit
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
