"""The message about lost frames tells what was measured in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from freeocc3d.capture import open_capture
from freeocc3d.core.errors import FrameError
from freeocc3d.core.types import Frame
from freeocc3d.pipeline.frame_losses import explain_losses


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    capture = open_capture("builtin:room", None, {"synthetic": {"frames": 240, "width": 320, "height": 240}})
    return [capture[index] for index in range(6)]


class Damaged:
    """Six frames, of which the last two are changed."""

    path, has_depth = "scan", True

    def __init__(self, frames: list[Frame], change: Callable[[Frame], Frame]):
        self.frames = [*frames[:4], *map(change, frames[4:])]

    def __getitem__(self, index: int) -> Frame:
        return self.frames[index]


LOST = SimpleNamespace(status=np.array(["keyframe", "tracked", "tracked", "tracked", "lost", "lost"], object))


def elsewhere(index: int) -> np.ndarray:
    """An image of a place that no other frame shows."""
    blocks = np.random.default_rng(index).integers(0, 256, (30, 40, 3), np.uint8)
    return np.kron(blocks, np.ones((8, 8, 1), np.uint8))


CHANGES: dict[str, tuple[Callable[[Frame], Frame], str]] = {
    "dark": (lambda f: replace(f, color=f.color // 16), "2 are nearly black (95 % of their pixels below "),
    "blurred": (lambda f: replace(f, color=cv2.GaussianBlur(f.color, (0, 0), 4)), "2 are blurred (sharpness 0."),
    "shallow": (lambda f: replace(f, depth_m=f.depth_m * (np.arange(320) < 16)), "2 have depth in "),
    "elsewhere": (lambda f: replace(f, color=elsewhere(f.index)), "share little with the frame before"),
    "nothing": (lambda f: f, "calibration or the registration of depth to color is the likely cause"),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_the_cause_is_what_was_measured(frames, name: str) -> None:
    change, words = CHANGES[name]
    said = explain_losses(Damaged(frames, change), LOST)  # type: ignore[arg-type]
    assert words in said
    others = {"dark": "nearly black", "blurred": "blurred", "shallow": "have depth in", "nothing": "likely cause"}
    assert not [text for other, text in others.items() if other != name and text in said and name != "elsewhere"]


def test_nothing_is_said_without_losses(frames) -> None:
    whole = SimpleNamespace(status=np.array(["keyframe"] * 6, object))
    assert explain_losses(Damaged(frames, lambda f: f), whole) == ""  # type: ignore[arg-type]


def test_frames_that_cannot_be_read_any_more() -> None:
    class Gone:
        has_depth = True

        def __getitem__(self, index: int) -> Frame:
            raise FrameError("gone")

    assert explain_losses(Gone(), LOST) == "None of them can be read any more."  # type: ignore[arg-type]


class WithoutDepth(Damaged):
    has_depth = False


def test_lost_frames_of_color_are_told_what_stereo_found(frames) -> None:
    """Nothing is said of a depth sensor that is not there."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    flat = WithoutDepth([replace(f, depth_m=f.depth_m * 0) for f in frames], lambda f: f)
    completed: list[int] = []

    def complete(frame: Frame) -> Frame:
        completed.append(frame.index)
        return replace(
            frame, depth_m=np.float32(2) * (np.arange(320) < (9 if frame.index > 3 else 300)) + 0 * frame.depth_m
        )

    said = explain_losses(flat, LOST, poses, True, complete)  # type: ignore[arg-type]
    assert "2 got depth from stereo in 3% of their pixels" in said
    assert set(completed) >= {4, 5}
    said = explain_losses(flat, LOST)  # type: ignore[arg-type]
    assert "registration" not in said
    assert "calibration" not in said


def test_frames_without_a_given_pose_are_counted(frames) -> None:
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[4] = np.nan
    shallow = Damaged(frames, CHANGES["shallow"][0])
    assert explain_losses(shallow, LOST, poses, True).startswith("Without a pose: 1. Of 1 of them")  # type: ignore[arg-type]
    poses[5] = np.nan
    assert explain_losses(shallow, LOST, poses, True) == "They have no pose."  # type: ignore[arg-type]
