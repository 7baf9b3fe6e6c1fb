"""Keyframes on disk: what is saved reads back, also scaled, and damage is reported."""

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scenes import wall_frame, with_sigma

from freeocc3d.core.errors import MapError
from freeocc3d.storage.keyframes import INDEX, Keyframes


@pytest.fixture
def kept(tmp_path: Path) -> Keyframes:
    """A frame of a sensor, and one whose depth says how uncertain it is, with a hole."""
    keyframes = Keyframes(tmp_path / "keyframes")
    keyframes.append(wall_frame(2.0, 0))
    frame = with_sigma(wall_frame(1.5, 7))
    frame.depth_m[:50] = 0
    keyframes.append(frame)
    keyframes.save_index()
    return keyframes


def test_depth_comes_back_to_half_a_millimeter_and_its_sigma_to_a_quarter(kept: Keyframes) -> None:
    sensor, stereo = Keyframes.load(kept.folder)
    assert sensor.depth_sigma_m is None
    np.testing.assert_allclose(sensor.depth_m, 2.0, atol=5e-4)
    known = stereo.depth_m > 0
    np.testing.assert_array_equal(known, wall_frame(1.5).depth_m * (np.arange(120) >= 50)[:, None] > 0)
    expected = with_sigma(wall_frame(1.5, 7)).depth_sigma_m
    np.testing.assert_allclose(stereo.depth_sigma_m[known], expected[known], atol=3e-4)


def test_a_sigma_below_what_is_kept_is_not_zero(tmp_path: Path) -> None:
    keyframes = Keyframes(tmp_path)
    keyframes.append(with_sigma(wall_frame(1.0), 1e-7, 2e-7))
    np.testing.assert_allclose(keyframes[0].depth_sigma_m, 5e-4)


def test_both_are_scaled(kept: Keyframes, tmp_path: Path) -> None:
    kept.copy_to(tmp_path / "half", 0.5)
    for frame, half in zip(kept, Keyframes.load(tmp_path / "half"), strict=True):
        np.testing.assert_allclose(half.depth_m, 0.5 * frame.depth_m, atol=6e-4)
        np.testing.assert_array_equal(half.color, frame.color)
        assert (half.depth_sigma_m is None) == (frame.depth_sigma_m is None)
    np.testing.assert_allclose(half.depth_sigma_m, 0.5 * frame.depth_sigma_m, atol=3e-4)


def test_an_image_that_is_gone_is_named(kept: Keyframes) -> None:
    entries = json.loads((kept.folder / INDEX).read_text())
    (kept.folder / INDEX).write_text(json.dumps([{**entries[0], "sigma": 1.0}]))
    with pytest.raises(MapError, match=r"000000\.depth_sigma\.png"):
        _ = Keyframes.load(kept.folder)[0]


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:-9])])
def test_a_resumed_run_writes_only_damaged_images_again_with_the_same_content(kept: Keyframes, damage) -> None:
    frames = {0: wall_frame(2.0, 0), 7: with_sigma(wall_frame(1.5, 7))}
    frames[7].depth_m[:50] = 0
    checkpoint = kept.checkpoint()
    before = {path: path.read_bytes() for path in kept.paths()}
    damage(kept.paths()[-1])
    asked: list[int] = []
    resumed = Keyframes.resumed(kept.folder, checkpoint, lambda index: asked.append(index) or frames[index])
    assert asked == [7]
    assert {path: path.read_bytes() for path in resumed.paths()} == before
    assert resumed.frames == [0, 7]
    assert resumed.checkpoint() == checkpoint


def huge(path: Path) -> None:
    """A small PNG whose header states ten thousand million pixels."""
    header = b"IHDR" + struct.pack(">II5B", 100_000, 100_000, 16, 0, 0, 0, 0)
    data = bytearray(path.read_bytes())
    data[12:33] = header + struct.pack(">I", zlib.crc32(header))
    path.write_bytes(data)


def encoded(values: np.ndarray, form: str = ".png") -> Callable[[Path], object]:
    return lambda path: path.write_bytes(cv2.imencode(form, values)[1].tobytes())


DEPTHS: dict[str, Callable[[Path], object]] = {
    "huge": huge,
    "of another size": encoded(np.zeros((60, 80), np.uint16)),
    "of 8 bits": encoded(np.zeros((120, 160), np.uint8)),
    "in color": encoded(np.zeros((120, 160, 3), np.uint16)),
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-50]),
    "empty": lambda path: path.write_bytes(b""),
    "a text": lambda path: path.write_text("depth"),
    "missing": Path.unlink,
}


@pytest.mark.parametrize("kind", DEPTHS)
def test_images_are_refused_before_they_are_decoded(kept: Keyframes, kind: str) -> None:
    path = kept.folder / "000000.depth.png"
    assert kept[0].depth_m.shape == (120, 160)
    DEPTHS[kind](path)
    with pytest.raises(MapError, match=r"000000\.depth\.png"):
        Keyframes.load(kept.folder).depth_m(0)


def test_a_pipe_among_the_images_does_not_block(kept: Keyframes) -> None:
    path = kept.folder / "000000.color.jpg"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(MapError, match="a pipe"):
        _ = Keyframes.load(kept.folder)[0]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("frame", -1), ("frame", 2**31), ("frame", 0.5), ("frame", None), ("frame", "0"), ("frame", 7),
        ("timestamp", float("nan")), ("timestamp", 1e300), ("width", 0), ("width", 1e9), ("width", 3.5), ("height", []),
        ("fx", 0), ("fx", -5.0), ("fx", float("inf")), ("fy", float("nan")), ("cx", 1e300), ("cy", "x"), ("sigma", "x"),
    ],
)  # fmt: skip
def test_an_index_of_what_no_camera_has_is_refused(kept: Keyframes, key: str, value: Any) -> None:
    entries = json.loads((kept.folder / INDEX).read_text())
    entries[0][key] = value
    (kept.folder / INDEX).write_text(json.dumps(entries))
    with pytest.raises(MapError, match=r"keyframes\.json is damaged: "):
        Keyframes.load(kept.folder)
