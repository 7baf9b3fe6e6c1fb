from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from freeocc3d.capture.base import Capture, Options
from freeocc3d.capture.read_ahead import read_ahead
from freeocc3d.core.errors import FrameError
from freeocc3d.core.types import Frame, Intrinsics


class Numbers(Capture):
    """Frames that are their index. Frames in ``broken`` raise FrameError, those in ``faulty`` RuntimeError."""

    format, layout = "numbers", "nothing"

    def __init__(self, n: int, broken: tuple[int, ...] = (), faulty: tuple[int, ...] = ()):
        super().__init__(Path(), Options())
        self.timestamps = np.arange(n, dtype=float)
        self.broken, self.faulty = broken, faulty
        self.asked: list[int] = []
        self.threads: set[int] = set()

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False

    def __getitem__(self, index: int) -> Frame:
        self.asked.append(index)
        self.threads.add(threading.get_ident())
        if index in self.broken:
            raise FrameError(f"frame {index} is broken")
        if index in self.faulty:
            raise RuntimeError(f"frame {index} shows a fault of the program")
        color, depth_m = np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32)
        return Frame(index, float(index), color, depth_m, Intrinsics(2, 2, 1.0, 1.0, 0.5, 0.5))


@pytest.mark.parametrize("depth", [0, 1, 4, 50])
def test_all_frames_come_in_order(depth: int) -> None:
    capture = Numbers(20)
    frames = list(read_ahead(capture, range(1, 20, 2), depth))
    assert [index for index, _ in frames] == [frame.index for _, frame in frames] == list(range(1, 20, 2))
    assert threading.get_ident() not in capture.threads
    assert len(capture.threads) == 1


def test_a_broken_frame_is_yielded_in_its_place() -> None:
    frames = dict(read_ahead(Numbers(6, broken=(0, 3)), range(6)))
    assert [index for index, frame in frames.items() if isinstance(frame, FrameError)] == [0, 3]
    assert str(frames[3]) == "frame 3 is broken"


def test_other_exceptions_reach_the_consumer_after_the_frames_before_them() -> None:
    before = threading.active_count()
    reader = read_ahead(Numbers(6, faulty=(3,)), range(6))
    assert [next(reader)[0] for _ in range(3)] == [0, 1, 2]
    with pytest.raises(RuntimeError, match="frame 3"):
        next(reader)
    assert threading.active_count() == before


def test_no_more_than_depth_frames_are_decoded_ahead() -> None:
    capture = Numbers(1000)
    reader = read_ahead(capture, range(1000), depth=3)
    for used in range(1, 100):
        next(reader)
        assert len(capture.asked) <= used + 3
    reader.close()


def test_leaving_early_ends_the_thread() -> None:
    before = set(threading.enumerate())
    capture = Numbers(1000)
    for index, _ in read_ahead(capture, range(1000), depth=4):
        if index == 5:
            break
    assert set(threading.enumerate()) == before
    assert len(capture.asked) <= 10


def interrupt(capture: Capture) -> None:
    for _ in read_ahead(capture, range(1000)):
        raise KeyboardInterrupt


def test_an_interrupt_of_the_consumer_ends_the_thread() -> None:
    before = set(threading.enumerate())
    capture = Numbers(1000)
    with pytest.raises(KeyboardInterrupt):
        interrupt(capture)
    # The traceback held the generator until here.
    assert set(threading.enumerate()) == before
    assert len(capture.asked) <= 5


def test_nothing_is_decoded_before_the_first_frame_is_wanted() -> None:
    capture = Numbers(10)
    reader = read_ahead(capture, range(10))
    assert not capture.asked
    reader.close()
    assert not list(read_ahead(capture, []))
