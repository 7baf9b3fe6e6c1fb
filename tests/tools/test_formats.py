"""The benchmark of formats on the built-in room, its table, and what it takes decoding alone to be."""

from pathlib import Path

import numpy as np
import pytest
from benchmark import decoding, formats
from scans import room_scan
from written_captures import WRITTEN

from freeocc3d.capture import open_capture


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    def open_small(path, options=None):
        own = {"synthetic": {"frames": 240, "width": 160, "height": 120}} if path == "builtin:room" else None
        return open_capture(path, options, own)

    monkeypatch.setattr(formats, "open_capture", open_small)
    for name, value in (("PIECE", 12), ("READ", 3), ("REPEATS", 1), ("MANY", 40), ("MANY_READ", 20), ("WARM", 5)):
        monkeypatch.setattr(formats, name, value)


@pytest.mark.usefixtures("small")
def test_figures_of_the_room(tmp_path: Path) -> None:
    scan = formats.take_piece("builtin:room")
    row, frames = formats.measure_format(WRITTEN[formats.BASE], scan, tmp_path / "base", None)
    assert (row["frames"], row["with_pose"]) == (12, 12)
    assert 0 < row["ate_rmse_m"] < 0.05
    assert min(row["reading_s"], row["decoding_s"], row["opening_s"]) > 0
    same, _ = formats.measure_format(WRITTEN["7-Scenes"], scan, tmp_path / "same", (frames, 0.5))
    assert (same["equal"], same["ate_rmse_m"]) == (True, 0.5)
    color, _ = formats.measure_format(WRITTEN["COLMAP, text"], scan, tmp_path / "color", (frames, 0.5))
    assert "ate_rmse_m" not in color
    rows = [{"capture": "room", "format": "a", "reader": "b", **figures} for figures in (row, same, color)]
    lines = formats.tabulate_formats(rows)[1:]
    assert len({line.count("|") for line in lines}) == 1
    assert "equal frames" in lines[3]


def test_what_failed_is_reported() -> None:
    assert "no folder" in formats.tabulate_formats([{"capture": "room", "error": "no folder"}])[-1]
    assert formats.tabulate_formats([]) == []


@pytest.mark.parametrize("kind", sorted({written.color for written in WRITTEN.values()} - {"video"}))
def test_color_is_decoded_as_it_was(tmp_path: Path, kind: str) -> None:
    images = [np.asarray(image) for image in room_scan().color[:3]]
    packed = decoding.PackedImages(tmp_path / "images", images, kind)
    for index in (2, 0):
        np.testing.assert_array_equal(packed(index), images[index])
    packed.close()


@pytest.mark.parametrize("kind", sorted({written.depth for written in WRITTEN.values()} - {"exr"}))
def test_depth_is_decoded_as_it_was(tmp_path: Path, kind: str) -> None:
    scan = room_scan()
    floats = kind in ("npy", "npz", "pfm", "tiff")
    images = [scan.depth_m[index] if floats else scan.stored(index) for index in range(3)]
    packed = decoding.PackedImages(tmp_path / "images", images, kind)
    for index in (2, 0):
        np.testing.assert_array_equal(packed(index), images[index])
    packed.close()


def test_exr_and_video_are_decoded_as_they_were(tmp_path: Path) -> None:
    scan = room_scan()
    for images, packed in (
        (scan.depth_m[:3], decoding.ExrImages(tmp_path, list(scan.depth_m[:3]))),
        (scan.color[:3], decoding.VideoImages(tmp_path / "color.mp4", list(scan.color[:3]))),
    ):
        for index in (0, 2, 1):
            np.testing.assert_array_equal(packed(index), images[index])
        packed.close()
