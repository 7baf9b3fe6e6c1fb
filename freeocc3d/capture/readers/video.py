"""Reads a video file (mp4, mov, mkv, webm, avi, …): upright frames by index, with the file's own times.

Opening reads the whole file once, without decoding, to know the time of every frame. Decoding a frame continues from
the decoder's position or starts at the last key frame before the frame, whichever is nearer. So reading in ascending
order, with any stride, passes through the file once. Raw H.264 and H.265 streams have the rate that they state, else
one frame a second, and are read from their start. A process of its own decodes (see ``video_process``).
"""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np

from ...core.types import Frame, Intrinsics
from ..base import Capture, Options
from ..cameras.camera_files import convert_35mm, guess_camera, read_given_calibration, reduce_camera
from ..videos.video_process import VideoProcess

REQUIRES: tuple[str, ...] = ("av",)


class Reader(Capture):
    """Timestamps are the file's own, in seconds, at a constant or variable rate. The stated rotation is applied, pixels
    become square, and images are reduced to ``capture.max_size``.

    The camera is ``capture.intrinsics``, for the upright size before reduction; else a guess, based on the lens if the
    file states it. Raises CaptureError: not a video, no decodable frame, or a missing codec.
    """

    format = "video"
    layout = "a video file, such as scan.mp4 or scan.mov"
    reads_files = True
    general = True
    has_depth = False

    def __init__(self, path: Path, options: Options):
        super().__init__(path, options)
        self._lock = threading.Lock()
        self._decoder = VideoProcess(path)
        video = self._decoder.video
        self.timestamps = video.times
        size = video.size
        lens = convert_35mm(video.focal_35mm, size)
        stated = read_given_calibration(options)
        camera = stated.camera(size) if stated else lens or guess_camera(size)
        self.intrinsics_known, self.focal_stated = stated is not None, stated is not None or lens is not None
        self.intrinsics: Intrinsics = reduce_camera(camera, options.max_size)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return path.is_file()

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"Frame {index} of a video of {len(self)} frames.")
        camera = self.intrinsics
        with self._lock:
            color = self._decoder.image(index, (camera.width, camera.height))
        depth_m = np.zeros(color.shape[:2], np.float32)
        return Frame(index, float(self.timestamps[index]), color, depth_m, camera)
