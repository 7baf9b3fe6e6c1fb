from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
import types
import zlib
from pathlib import Path
from typing import Any

import pytest
from small_captures import write_replica, write_scannet, write_seven_scenes

from freeocc3d.capture import Options, open_capture, select_frames
from freeocc3d.capture.checks.depth_units import settle_depth_unit
from freeocc3d.core.errors import CaptureError, ConfigError, FrameError
from freeocc3d.settings import config, registry


@pytest.mark.parametrize(
    ("write", "name"),
    [(write_seven_scenes, "seven_scenes"), (write_replica, "replica"), (write_scannet, "scannet")],
)
def test_a_layout_is_recognized(tmp_path: Path, write, name: str) -> None:
    write(tmp_path, 2)
    capture = open_capture(str(tmp_path))
    assert capture.format == name
    assert registry.backends("capture.readers")[name].summary
    assert len(open_capture(tmp_path, Options(format=name))) == 2


def test_no_folder_and_no_directory(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"There is no folder .*nowhere"):
        open_capture(tmp_path / "nowhere")
    (tmp_path / "scan.zip").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"scan\.zip: it is empty"):
        open_capture(tmp_path / "scan.zip")


def test_an_unrecognized_folder_says_what_it_holds(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(CaptureError, match="not a capture of a known format") as caught:
        open_capture(tmp_path)
    assert "holds notes.txt, but neither images nor a video" in str(caught.value)


def test_the_folder_above_a_capture_points_to_it(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path / "seq-01", 1)
    with pytest.raises(CaptureError, match=r"but .*seq-01 is: give that folder"):
        open_capture(tmp_path)


def test_a_folder_of_two_formats_has_to_be_named(tmp_path: Path) -> None:
    write_replica(tmp_path, 1)
    write_scannet(tmp_path, 1)
    with pytest.raises(CaptureError, match=r"of the format replica or scannet: choose one with capture\.format"):
        open_capture(tmp_path)
    assert open_capture(tmp_path, Options(format="scannet")).format == "scannet"


def test_an_unknown_format_names_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'replica'"):
        open_capture(tmp_path, Options(format="replicca"))


def test_a_format_that_does_not_fit_says_what_is_missing(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 1)
    with pytest.raises(CaptureError, match="results holds no color images"):
        open_capture(tmp_path, Options(format="replica"))


@pytest.mark.parametrize(
    "given",
    [
        {"max_depth": 0.0},
        {"depth_scale": 0.0},
        {"max_broken": 1.5},
        {"stride": 0},
        {"start": -1},
        {"scale": 0.0},
        {"max_size": 2},
        {"color_focal": 3.0},
        {"intrinsics": (585.0, 0.0, 320.0, 240.0)},
    ],
)
def test_options_out_of_range(given: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=rf"'capture\.{next(iter(given))}' must be"):
        config.resolve({"capture": given})
    with pytest.raises(ConfigError, match=f"'{next(iter(given))}' must be"):
        Options(**given)


def test_a_builtin_path_goes_to_the_synthetic_reader_with_its_own_options(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = types.SimpleNamespace(Reader=lambda *arguments: arguments)
    monkeypatch.setattr(registry, "load", lambda folder, name: fake if name == "synthetic" else None)
    monkeypatch.setattr(registry, "build_options", lambda module, values, where: values)
    options = Options(stride=2)
    opened = open_capture("builtin:room", options, {"synthetic": {"frames": 7}, "other": {}})
    assert opened == (Path("builtin:room"), options, {"frames": 7})


def test_used_frames_follow_the_options(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, 10)
    assert list(select_frames(open_capture(tmp_path))) == list(range(10))
    assert list(select_frames(open_capture(tmp_path, Options(start=1, stop=8, stride=3)))) == [1, 4, 7]
    with pytest.raises(CaptureError, match="No frame of"):
        select_frames(open_capture(tmp_path, Options(start=10)))


def test_opening_a_capture_imports_nothing_heavy() -> None:
    code = "import sys, freeocc3d.capture; print({'open3d', 'torch', 'scipy', 'numba'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"


@pytest.mark.parametrize("target", ["pipe", "/dev/zero", "loop", "bomb", "huge"])
@pytest.mark.parametrize("name", ["color/1.png", "depth/1.png"])
def test_a_hostile_image_is_a_broken_frame(tmp_path: Path, name: str, target: str) -> None:
    """A pipe would block, a device fill the memory, an image of gigapixels do both or end the run."""
    path = write_scannet(tmp_path, 3) / name
    path.unlink()
    if target == "pipe":
        os.mkfifo(path)
    elif target in ("bomb", "huge"):
        side = 30_000 if target == "bomb" else 1 << 30
        head = b"IHDR" + struct.pack(">IIBBBBB", side, side, 16, 0, 0, 0, 0)
        data = struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + data + struct.pack(">I", 0) + b"IEND\xaeB`\x82")
    else:
        path.symlink_to(path if target == "loop" else target)
    capture = open_capture(tmp_path)
    with pytest.raises(FrameError, match=rf"{name}"):
        capture[1]
    assert capture[0].color.shape == (24, 32, 3)
    assert settle_depth_unit(capture) is None


@pytest.mark.parametrize("name", ["intrinsic/intrinsic_color.txt", "pose/1.txt", "classes.json"])
@pytest.mark.parametrize("target", ["pipe", "/dev/zero", "loop"])
def test_a_hostile_document_is_told_and_not_left_out(tmp_path: Path, name: str, target: str) -> None:
    path = write_scannet(tmp_path, 3) / name
    path.unlink(missing_ok=True)
    if target == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(path if target == "loop" else target)
    with pytest.raises(CaptureError, match=rf"{name}"):
        open_capture(tmp_path).pose(1)


def test_a_link_that_leads_nowhere_is_called_one(tmp_path: Path) -> None:
    (tmp_path / "away").symlink_to(tmp_path / "nowhere")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("away", "loop"):
        with pytest.raises(CaptureError, match=f"{name} is a link to .*correct the link"):
            open_capture(tmp_path / name)


def test_every_refusal_names_the_capture(tmp_path: Path) -> None:
    """Also where the reason is found by code that does not know it."""
    write_scannet(tmp_path / "scan", 2, color_size=(64, 36))
    shutil.rmtree(tmp_path / "scan" / "intrinsic")
    with pytest.raises(CaptureError, match=r"scan: One camera cannot have taken .*intrinsic/intrinsic_depth\.txt"):
        open_capture(tmp_path / "scan")
