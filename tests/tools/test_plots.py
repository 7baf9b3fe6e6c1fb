"""The benchmark's pictures: their content, and the same file from the same figures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmark import plots

pytest.importorskip("matplotlib")


ROWS = [
    {"capture": "kitchen", "variant": "ours", "iou": 0.651, "ms_per_frame": {"track": 12.0, "carve": 9.0}},
    {"capture": "kitchen", "variant": "lost", "iou": None},
    {"capture": "bedroom", "variant": "ours", "iou": 0.0, "ms_per_frame": {"track": 10.0, "save": 1.0}},
    {"capture": "bedroom", "variant": "failed", "ms_per_frame": None},
]


def draw_trajectory(path: Path, up: tuple[float, float, float] = (0, 0, 1)) -> None:
    angle = np.linspace(0, 6, 50)
    true = np.stack((2 * np.cos(angle), np.sin(angle), 0.1 * angle), axis=1)
    estimated = true[::2] + (0.02, 0.01, 0.0)
    plots.trajectory_plot(path, "a walk", true, estimated, np.linalg.norm(estimated - true[::2], axis=1), up)


DRAWN = {
    "trajectory": draw_trajectory,
    "iou": lambda path: plots.iou_bars(path, ROWS),
    "stages": lambda path: plots.stage_bars(path, ROWS),
}


def text_of(name: str, tmp_path: Path) -> str:
    """The picture as SVG, in which text is text."""
    DRAWN[name](tmp_path / "picture.svg")
    return (tmp_path / "picture.svg").read_text()


@pytest.mark.parametrize("name", DRAWN)
def test_the_same_figures_draw_the_same_picture(name, tmp_path) -> None:
    for file in ("a.png", "b.png", "a.svg", "b.svg"):
        DRAWN[name](tmp_path / file)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    image = cv2.imread(str(tmp_path / "a.png"))
    assert min(image.shape[:2]) > 200
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50


def test_a_missing_iou_is_not_zero(tmp_path) -> None:
    text = text_of("iou", tmp_path)
    assert text.count("not available") == 2
    assert "65.1" in text
    assert ">0.0<" in text  # the one that is
    assert text.index("kitchen") < text.index("bedroom")


def test_stages_of_rows_that_have_them(tmp_path) -> None:
    text = text_of("stages", tmp_path)
    assert all(stage in text for stage in ("track", "carve", "save", "kitchen, ours", "bedroom, ours"))
    assert "lost" not in text
    assert "failed" not in text


def test_a_trajectory_states_its_units(tmp_path) -> None:
    text = text_of("trajectory", tmp_path)
    assert all(label in text for label in ("a walk", "meters", "error (cm)", "true path", "estimated"))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.1, -2, 0.4)])
def test_the_picture_looks_down(up) -> None:
    right, forward = plots.seen_from_above(np.array(up, float))
    np.testing.assert_allclose(np.cross(right, forward), np.array(up) / np.linalg.norm(up), atol=1e-12)


def test_nothing_measured_is_an_empty_picture(tmp_path) -> None:
    plots.iou_bars(tmp_path / "iou.png", [])
    plots.stage_bars(tmp_path / "stages.png", [])
    assert (tmp_path / "iou.png").is_file()
    assert (tmp_path / "stages.png").is_file()


def test_more_names_than_colors_are_distinguished() -> None:
    looks = plots._looks(str(n) for n in range(30))
    assert len({(look["color"], look["hatch"]) for look in looks.values()}) == 30
