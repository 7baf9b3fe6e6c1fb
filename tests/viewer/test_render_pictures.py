"""The picture of rendered views."""

from pathlib import Path

import cv2
import numpy as np
import torch
from scenes import lifted, wall_frame

from freeocc3d.gaussians import rendered_views
from freeocc3d.gaussians.rasterizers import cpu
from freeocc3d.viewer import render_pictures


def test_a_view_is_drawn_next_to_what_was_captured(tmp_path: Path) -> None:
    frame = wall_frame(2.0)
    view = rendered_views.prepare_captured_view(frame, np.eye(4), 320, torch.device("cpu"))
    rows = [(7, view), (9, view)]
    render_pictures.write_render_picture(
        tmp_path / "g.png", lifted([frame], [np.eye(4)]), rows, cpu.load(), Path("scan")
    )
    picture = cv2.imread(str(tmp_path / "g.png"))
    assert picture.shape[1] == 4 * 408 + 8
    top = 56 + 30
    photograph, rendered = picture[top : top + 300, 8:408].astype(int), picture[top : top + 300, 416:816].astype(int)
    assert photograph.std() > 20
    assert np.abs(photograph - rendered)[50:250, 50:350].mean() < 40
    assert np.corrcoef(photograph[50:250, 50:350].ravel(), rendered[50:250, 50:350].ravel())[0, 1] > 0.7


def test_a_view_without_depth_is_drawn_all_the_same(tmp_path: Path) -> None:
    frame = wall_frame(2.0)
    turned = np.diag((-1.0, 1.0, -1.0, 1.0))  # away from the wall
    blank = rendered_views.prepare_captured_view(wall_frame(0.0), turned, 320, torch.device("cpu"))
    render_pictures.write_render_picture(
        tmp_path / "g.png", lifted([frame], [np.eye(4)]), [(0, blank)], cpu.load(), Path("scan")
    )
    assert cv2.imread(str(tmp_path / "g.png")) is not None
