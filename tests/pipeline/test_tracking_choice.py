"""The tracker that is chosen for a capture."""

from __future__ import annotations

from pathlib import Path

import pytest
from posed_captures import write_colmap, write_nerfstudio
from small_captures import color_image, write_image, write_scannet

from freeocc3d.capture import open_capture
from freeocc3d.pipeline.tracking_choice import choose_tracker
from freeocc3d.settings import config


def write_photos(folder: Path, count: int) -> Path:
    for index in range(count):
        write_image(folder / f"{index}.jpg", color_image(index))
    return folder


@pytest.mark.parametrize(
    ("write", "depth", "backend", "why"),
    [
        (write_scannet, True, "rgbd", "has depth"),
        (write_nerfstudio, True, "rgbd", "has depth"),
        (lambda folder, count: write_nerfstudio(folder, count, depth=False), True, "known", "has poses but no depth"),
        (write_colmap, True, "known", "has poses but no depth"),
        (write_photos, True, "colmap", "has no depth"),
        (write_scannet, False, "colmap", "has no depth"),  # its poses are the truth, and stay unread
    ],
)
def test_the_tracker_fits_the_capture_and_the_reason_is_said(
    tmp_path: Path, write, depth: bool, backend: str, why: str
) -> None:
    write(tmp_path, 3)
    settings = config.resolve({"capture": {"depth": depth}})
    capture = open_capture(tmp_path, settings.capture)
    chosen, reason = choose_tracker(settings, capture)
    assert chosen.tracking.backend == backend
    assert reason.startswith(f"Tracking with {backend}: the capture {why}")
    assert f"read as {capture.format}, 3 frames" in reason
    assert choose_tracker(chosen, capture) == (chosen, "")
