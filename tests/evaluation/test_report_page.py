"""The report page: one file that shows the figures and states what is missing."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from freeocc3d.core.errors import DependencyError, ExportError
from freeocc3d.evaluation import report_page
from freeocc3d.evaluation.confusion import Prediction
from freeocc3d.evaluation.scene_scoring import ScoredScene
from freeocc3d.evaluation.scoring import Evaluation
from freeocc3d.evaluation.trajectory_errors import measure_trajectory_errors
from freeocc3d.evaluation.true_occupancy import GroundTruth
from freeocc3d.tracking.trajectory_alignment import Poses, TrajectoryAlignment
from freeocc3d.viewer.palette import assign_class_colors

CLASSES = ("wall", 'a <b>"sofa"</b> & co', "lamp")
VOID = {"meta", "img", "br", "link"}


class Page(HTMLParser):
    """Every element closed in order; the text, the addresses and the cells of the tables."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.rows: list[list[str]] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attributes if name in ("src", "href", "action", "data")]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words.append(data)
        if self.open[-1:] and {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def pictures(self) -> list[np.ndarray]:
        """(H, W, 3) RGB."""
        found = [a.removeprefix("data:image/png;base64,") for a in self.addresses if a.startswith("data:image/png")]
        return [cv2.imdecode(np.frombuffer(base64.b64decode(a), np.uint8), 1)[..., ::-1] for a in found]


def room(name: str = "room", classes: bool = True, way: bool = False) -> ScoredScene:
    """A floor with the class of walls, a sofa on it, partly missed and partly called a lamp, and an invented block;
    everything unknown to the truth is predicted occupied."""
    true = np.zeros((20, 12, 10), np.uint8)
    true[:, :, 0] = 1
    true[2:8, 2:8, 1:4] = 2
    true[:, :, 8:] = 255
    occupied = true > 0
    labels = np.where(true == 255, 3, true).astype(np.uint8)
    occupied[2:4, 2:8, 1:4] = False
    labels[6:8, 2:8, 1:4] = 3
    occupied[12:16, 4:8, 1:4] = True
    labels[12:16, 4:8, 1:4] = 1
    labels[~occupied] = 0
    errors = None
    if way:
        T = np.tile(np.eye(4), (40, 1, 1))
        T[:, :3, 3] = np.stack((np.linspace(0.2, 1.8, 40), np.linspace(0.2, 1.0, 40) ** 2, np.full(40, 0.7)), axis=1)
        off = T.copy()
        off[20:, 1, 3] += 0.03
        times = np.arange(40.0)
        errors = measure_trajectory_errors(Poses(times, off), Poses(times, T), TrajectoryAlignment.identity())
    truth = GroundTruth(true, np.zeros(3), 0.1, ("free", *CLASSES))
    return ScoredScene(
        name, truth, Prediction(occupied, labels if classes else None),
        TrajectoryAlignment.identity(), errors, 40, 40 if way else None, np.array((0.0, 0.0, 1.0)), ("A note & more.",),
    )  # fmt: skip


def written(path: Path, *scenes: ScoredScene, listed: bool = False) -> Page:
    report_page.write_report(Evaluation(scenes, CLASSES, "none", listed), path, overwrite=True)
    return Page(path)


def share(picture: np.ndarray, color: tuple[int, int, int]) -> float:
    """Of the pixels of the view from above, how many have this color but for the light on it."""
    seen = picture[: len(picture) // 2].astype(float)
    hue = seen / np.maximum(seen.max(axis=2, keepdims=True), 1)
    wanted = np.array(color) / max(color)
    return float((np.abs(hue - wanted).max(axis=2) < 0.04).mean())


def test_the_page_says_what_the_evaluation_says(tmp_path: Path) -> None:
    scene = room(way=True)
    evaluation = Evaluation((scene,), CLASSES, "none")
    page = written(tmp_path / "r.html", scene)
    scores = evaluation.scores
    for value in (scores.iou, scores.precision, scores.recall, evaluation.miou()):
        assert f"{100 * value:.1f} %" in page.text
    assert f"{100 * scene.errors.ate_rmse_m:.2f} cm" in page.text
    assert "A note & more." in page.text
    assert ["label", *(f"{100 * v:.1f}" for v in (scores.iou, evaluation.miou(), scores.precision, scores.recall)),
            f"{scores.voxels:,}"] in page.rows  # fmt: skip
    # 108 voxels of sofa: a third missed, a third a lamp, a third right.
    assert [CLASSES[1], "33.3", "", "66.7", "108", "not occupied 33.3, lamp 33.3"] in page.rows
    assert ["lamp", "0.0", "", "not in the truth", "0", ""] in page.rows
    # Free: 1308 voxels in the layers 1 to 7 less 108 and 48 that are invented as wall.
    free = 20 * 12 * 7 - 108
    assert ["free", f"{free:,}", f"{100 * (free - 48) / free:.0f}", "3", "", "", ""] in page.rows
    assert [CLASSES[1], "108", "33", "", "33", "33", ""] in page.rows
    listed = next(row for row in page.rows if row[0] == "listed")
    assert listed[1] == f"{100 * evaluation.miou(CLASSES):.1f}"
    assert "counted 0: lamp" in listed[2]


def test_the_page_needs_nothing_else_and_is_the_same_each_time(tmp_path: Path) -> None:
    page = written(tmp_path / "one.html", room(way=True))
    text = (tmp_path / "one.html").read_text()
    assert all(a.startswith(("data:image/png;base64,", "#")) for a in page.addresses)
    assert not re.search(r"https?:|@import|url\(|<script", text)
    assert "a <b>" not in text
    assert CLASSES[1] in page.text
    written(tmp_path / "two.html", room(way=True))
    assert (tmp_path / "two.html").read_text() == text
    with pytest.raises(ExportError, match="exists"):
        report_page.write_report(Evaluation((room(),), CLASSES, "none"), tmp_path / "one.html")
    with pytest.raises(ExportError, match="Cannot write"):
        report_page.write_report(Evaluation((room(),), CLASSES, "none"), tmp_path / "missing" / "one.html")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.html", "two.html"]


def test_pictures_show_truth_prediction_and_difference_alike_framed(tmp_path: Path) -> None:
    truth, prediction, difference = written(tmp_path / "r.html", room()).pictures()
    sofa, lamp = assign_class_colors(list(CLASSES))[2:4].tolist()
    assert share(truth, sofa) == pytest.approx(3 * share(prediction, sofa), rel=0.1)
    assert share(truth, lamp) == 0.0  # what the truth does not know is not drawn
    assert share(prediction, lamp) == pytest.approx(share(prediction, sofa), rel=0.1)
    colors = report_page.DIFFERENCES
    assert share(difference, colors["wrong class"]) == pytest.approx(share(prediction, lamp), rel=0.05)
    assert share(difference, colors["missed"]) == pytest.approx(share(truth, sofa) / 3, rel=0.1)
    # 4 x 4 voxels invented, 6 x 6 of the sofa, each seen from above.
    assert share(difference, colors["invented"]) == pytest.approx(share(truth, sofa) * 16 / 36, rel=0.1)
    right = replace(room(), predicted=Prediction(*(room().truth.labels % 255 > 0, room().truth.labels % 255)))
    same = written(tmp_path / "r.html", right).pictures()
    assert np.array_equal(same[0], same[1])
    assert np.array_equal(same[0], truth) is False  # framed by all that is drawn, and there is no invented block now
    assert share(same[2], colors["right"]) > 0.1


def test_every_voxel_has_one_difference() -> None:
    true = np.array([0, 0, 1, 1, 1, 1]).reshape(6, 1, 1)
    occupied = np.array([0, 1, 0, 1, 1, 1], bool).reshape(6, 1, 1)
    labels = np.array([0, 1, 0, 1, 2, 0]).reshape(6, 1, 1)
    names = ["", *report_page.DIFFERENCES]
    said = [names[k] for k in report_page.compare_voxels(true, occupied, labels).ravel()]
    assert said == ["", "invented", "missed", "right", "wrong class", "wrong class"]
    plain = [names[k] for k in report_page.compare_voxels(true, occupied, None).ravel()]
    assert plain == ["", "invented", "missed", "right", "right", "right"]


def test_what_is_not_available_is_not_a_zero(tmp_path: Path) -> None:
    page = written(tmp_path / "r.html", room(classes=False))
    assert "mIoU not available the prediction has no classes" in page.text
    assert "ATE not available no trajectory" in page.text
    assert "Confusion matrix Not available" in page.text
    assert "no trajectory was compared" in page.text
    assert [
        CLASSES[1],
        "not available",
        "",
        "66.7",
        "108",
        "not occupied 33.3, occupied, no class 66.7",
    ] not in page.rows
    assert ["frames", "not available: the truth has no masks of its frames"] in page.rows
    cells = [cell for row in page.rows for cell in row]
    assert "0.0" not in cells


def test_without_rendering_the_page_is_written_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> dict[str, bytes]:
        raise DependencyError("Pictures need pyvista with EGL and GL: apt-get install libegl1 libgl1.")

    monkeypatch.setattr(report_page, "draw_grids", fails)
    page = written(tmp_path / "r.html", room())
    assert page.pictures() == []
    assert "There are no pictures. Pictures need pyvista" in page.text


def test_a_room_of_nothing_and_several_rooms(tmp_path: Path) -> None:
    empty = room()
    nothing = replace(
        empty,
        truth=replace(empty.truth, labels=np.zeros((3, 3, 3), np.uint8)),
        predicted=Prediction(np.zeros((3, 3, 3), bool), np.zeros((3, 3, 3), np.uint8)),
    )
    assert "neither the truth nor the prediction has occupied voxels" in written(tmp_path / "r.html", nothing).text
    both = written(tmp_path / "r.html", room("first <i>", way=True), room("second"))
    assert len(both.pictures()) == 6
    assert [row[0] for row in both.rows if row[0] in ("first <i>", "second")] == ["first <i>", "second"]
    assert "2 scenes, pooled by voxels" in both.text
    assert "#scene-2" in both.addresses


def test_ways_are_drawn_from_above_in_centimeters_with_y_down() -> None:
    scene = room(way=True)
    drawn = report_page._drawn_way(scene)
    errors = scene.errors
    assert errors is not None
    true = np.array([list(map(float, pair.split(","))) for pair in drawn["true"].split()])
    pieces = np.array([piece[:4] for piece in drawn["pieces"]])
    for found, points in (
        (true, errors.true),
        (pieces[:, :2], errors.aligned[:-1]),
        (pieces[:, 2:], errors.aligned[1:]),
    ):
        drawn_steps, steps = np.diff(found[::13], axis=0), 100 * np.diff(points[::13, :2], axis=0)
        np.testing.assert_allclose(drawn_steps @ drawn_steps.T, steps @ steps.T, atol=6.0)  # lengths and angles
        turns, true_turns = (a[:-1, 0] * a[1:, 1] - a[:-1, 1] * a[1:, 0] for a in (drawn_steps, steps))
        np.testing.assert_allclose(turns, -true_turns, rtol=0.03)  # y points down
    every = np.concatenate((true, pieces[:, :2], pieces[-1:, 2:]))
    np.testing.assert_allclose(every.min(axis=0), 0.0, atol=0.06)
    extent = every.max(axis=0)
    x, y, width, height = drawn["box"]
    np.testing.assert_allclose((x, y), -0.04 * extent.max(), rtol=0.01)
    np.testing.assert_allclose((width, height), extent + 0.08 * extent.max(), rtol=0.01)
    assert drawn["worst"] == errors.errors_m.max()
    np.testing.assert_allclose(drawn["start"], true[0], atol=0.06)
