"""An answer as one page: it shows the regions that were found, and needs no other file."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec import structs

from freeocc3d.core.errors import DependencyError, ExportError
from freeocc3d.pipeline.run import reconstruct
from freeocc3d.query.best_views import RegionView
from freeocc3d.query.scan_map import Map
from freeocc3d.storage.manifest import MapScale
from freeocc3d.viewer import answer_page
from freeocc3d.viewer.self_contained_pages import crop_view


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Map:
    settings = {
        "capture": {"stride": 24, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}},
        "tracking": {"backend": "known"},
        "fitting": {"passes": 0},
    }
    return reconstruct("builtin:room", tmp_path_factory.mktemp("page") / "room", settings)


class Strict(HTMLParser):
    """Collects what a page names, and whether its elements nest."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def decoded(source: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(source.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_the_page_shows_regions_map_and_crops(room: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = room.query_words(["red", "<b>blue</b>", "unicorn"])
    answer_page.write_query_page(room, results, tmp_path / "q.html")
    text = (tmp_path / "q.html").read_text(encoding="utf-8")
    read = Strict()
    read.feed(text)
    assert read.open == []
    assert all(source.startswith("data:image/") for source in read.sources)
    assert "prefers-color-scheme: dark" in text
    assert "<b>blue" not in text
    assert "is not understood" in text
    for result in results[:1]:
        for region in result.regions:
            assert " ".join(f"{value:.2f}" for value in region.centroid) in text
    views = [view for result in results for region in result.regions for view in room.views_of(region)]
    assert len(read.sources) == 1 + len(views)
    assert decoded(read.sources[0]).shape == (900, 1600, 3)
    for source, view in zip(read.sources[1:], views, strict=True):
        crop = decoded(source)
        assert crop.shape[0] <= 240
        assert crop.shape[1] <= 320
        assert f"box {' '.join(map(str, view.box))}" in text
    with pytest.raises(ExportError, match="--overwrite"):
        answer_page.write_query_page(room, results, tmp_path / "q.html")
    answer_page.write_query_page(room, results, tmp_path / "q.html", overwrite=True)
    assert (tmp_path / "q.html").read_text(encoding="utf-8") == text
    assert "Meters in the map" in text
    unknown = structs.replace(room.manifest, scale=MapScale(metric=False, by="none"))
    monkeypatch.setattr(room, "manifest", unknown)
    answer_page.write_query_page(room, results, tmp_path / "q.html", overwrite=True)
    text = (tmp_path / "q.html").read_text(encoding="utf-8")
    assert "lengths are not meters" in text
    assert " l</td>" not in text
    assert " units³</td>" in text
    assert "liter" not in text
    assert "nowhere" not in text


def test_a_crop_holds_the_box_in_the_words_color() -> None:
    image = np.full((120, 160, 3), 90, np.uint8)
    image[40:60, 50:90] = 255
    crop = decoded(crop_view(image, RegionView(0, (50, 40, 89, 59), 1.0), (255, 60, 30)))
    red = (crop[..., 0] > 200) & (crop[..., 1] < 130)
    white = crop.min(axis=-1) > 200
    rows, columns = np.nonzero(red)
    assert rows.min() < np.nonzero(white)[0].min()
    assert columns.max() > np.nonzero(white)[1].max()
    assert white.mean() > 0.2
    edge = decoded(crop_view(image, RegionView(0, (0, 0, 159, 119), 1.0), (255, 60, 30)))
    assert edge.shape == (240, 320, 3)


def test_without_a_display_the_page_says_so(room: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(*_: object) -> bytes:
        raise DependencyError("Pictures need a display.")

    monkeypatch.setattr(answer_page, "draw_query", lacking)
    answer_page.write_query_page(room, room.query_words(["unicorn"]), tmp_path / "q.html")
    text = (tmp_path / "q.html").read_text(encoding="utf-8")
    assert "The map is not drawn: Pictures need a display." in text
    assert not re.findall("<img", text)


def test_an_empty_map_has_no_page(room: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    empty = Map(room.path, room.manifest)
    occupancy = room.occupancy
    nothing = occupancy.replace(
        state=np.zeros_like(occupancy.state), features=occupancy.features[:0], colors=occupancy.colors[:0]
    )
    monkeypatch.setitem(empty.__dict__, "occupancy", nothing)
    (result,) = empty.query_words(["red"])
    assert result.note == "The map has no occupied voxels."
    assert empty.query_classes(["red"])[0].regions == []
    assert empty.query_image(np.full((8, 8, 3), 200, np.uint8)).note == "The map has no occupied voxels."
    with pytest.raises(ExportError, match="has no occupied voxels to draw"):
        answer_page.write_query_page(empty, [result], tmp_path / "q.html")
    assert list(tmp_path.iterdir()) == []
