"""Runs that are killed at any moment, and checkpoints that are torn or flipped: a resumed run makes the same map to the
byte, or says in a sentence why not."""

from __future__ import annotations

import multiprocessing
import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import Any

from pipeline_runs import content

import freeocc3d
from freeocc3d.core.progress import Progress
from freeocc3d.pipeline import run_stages
from freeocc3d.storage.work_folder import WorkFolder

from .harness import Attack, Silent

SHORT = 3

SETTINGS: dict[str, Any] = {
    "capture": {"synthetic": {"frames": 120, "width": 96, "height": 72}, "stop": 12, "color_focal": 1},
    "fitting": {"passes": 1},
}
STAGES = ("refinement", "gaussians", "language", "occupancy", "saving", "finish")
_CHECKPOINT_FRAMES = 3
_FINISHING = 0.2
"""Share of the kills that hit the moments in which the map gets its name."""


class _Snapshots(Progress):
    """Copies the work folder of a run when each stage begins: what is left of a run that is stopped there."""

    def __init__(self, output: Path):
        self.work = output.with_name(f"{output.name}.partial")

    def stage(self, name: str, total: int | None = None) -> None:
        if name in STAGES:
            shutil.copytree(self.work, self.work.with_name(f"{name}.partial"))


def _reconstruct(output: Path, **options: Any) -> None:
    run_stages._CHECKPOINT_FRAMES = _CHECKPOINT_FRAMES
    freeocc3d.reconstruct("builtin:room", output, SETTINGS, **options)


def prepare(folder: Path) -> None:
    """An uninterrupted map, its work folders as they were at each stage, how long a run takes, and a map to
    replace."""
    finish, progress = WorkFolder.finish, _Snapshots(folder / "whole")

    def finish_later(self: WorkFolder, output: Path) -> None:
        progress.stage("finish")
        finish(self, output)

    WorkFolder.finish = finish_later  # type: ignore[method-assign]
    try:
        _reconstruct(folder / "whole", progress=progress)
    finally:
        WorkFolder.finish = finish  # type: ignore[method-assign]
    if missing := [stage for stage in STAGES if not (folder / f"{stage}.partial").is_dir()]:
        raise AssertionError(f"the run had no stages {missing}")
    start = time.perf_counter()
    _child(folder / "again", {}).join()
    (folder / "seconds").write_text(str(time.perf_counter() - start))
    _require_same(folder / "again", folder)
    shutil.rmtree(folder / "again")
    shutil.copytree(folder / "whole", folder / "old")


def attack(rng: random.Random, originals: Path, folder: Path) -> Attack:
    """A killed run, or a damaged file of a work folder."""
    return _kill(rng, originals, folder) if rng.random() < 0.5 else _damage(rng, originals, folder)


def _resume(output: Path, originals: Path, overwrite: bool = False) -> None:
    """Resume a run, and compare its map with that of the uninterrupted one. Raises Silent."""
    _reconstruct(output, resume=True, overwrite=overwrite)
    _require_same(output, originals)
    left = sorted(path.name for path in output.parent.iterdir())
    if left != [output.name]:
        raise Silent(f"beside the map there is {left}")


def _require_same(made: Path, originals: Path) -> None:
    one, other = content(made), content(originals / "whole")
    if differing := [name for name in one.keys() | other.keys() if one.get(name) != other.get(name)]:
        raise Silent(f"another map than that of an uninterrupted run: {sorted(differing)}")


def _damage(rng: random.Random, originals: Path, folder: Path) -> Attack:
    stage = rng.choice(STAGES)
    work = shutil.copytree(originals / f"{stage}.partial", folder / "map.partial")
    path = rng.choice([path for path in sorted(work.rglob("*")) if path.is_file()])
    data = bytearray(path.read_bytes())
    how = rng.choice(("cut", "flip", "zeros", "gone", "pipe"))
    at = rng.randrange(len(data)) if data else 0
    if how in ("gone", "pipe"):
        path.unlink()
    if how == "pipe":
        os.mkfifo(path)
    elif how == "cut":
        path.write_bytes(data[:at])
    elif how == "zeros":
        path.write_bytes(data[:at] + bytes(len(data) - at))
    elif how == "flip" and data:
        data[at] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
    description = f"stopped at {stage}, {path.relative_to(work)}: {how} at {at} of {len(data)}"
    return Attack(description, lambda: _resume(folder / "map", originals))


def _kill(rng: random.Random, originals: Path, folder: Path) -> Attack:
    """A run, killed once or twice, then resumed."""
    replaces = rng.random() < 0.5
    if replaces:
        shutil.copytree(originals / "old", folder / "map")
    kills = [_moment(rng, float((originals / "seconds").read_text())) for _ in range(rng.choice((1, 1, 2)))]

    def run() -> None:
        for number, (seconds, call) in enumerate(kills):
            options = {"overwrite": replaces or number > 0, "resume": number > 0}
            if number and (folder / "map").exists() and not replaces:
                break  # it had finished
            process = _child(folder / "map", options, call)
            process.join(seconds)
            process.kill()
            process.join()
            if replaces and not (folder / "map" / "map.yaml").is_file():
                raise Silent("neither the old map nor the new one is there")
        finished = (folder / "map").exists() and not (folder / "map.partial").exists()
        if finished and not replaces:
            for name in ("lock", "stages.json"):  # the next run removes them
                (folder / "map" / name).unlink(missing_ok=True)
            _require_same(folder / "map", originals)
        else:
            _resume(folder / "map", originals, overwrite=replaces)

    said = ", ".join(f"call {call} of finishing" if call else f"{seconds:.2f} s" for seconds, call in kills)
    return Attack(f"killed at {said}{' over a map' if replaces else ''}", run)


def _moment(rng: random.Random, usual_s: float) -> tuple[float | None, int]:
    """When to kill: after some seconds, or before one of the calls that give the map its name."""
    if rng.random() < _FINISHING:
        return None, rng.randrange(1, 16)
    return rng.uniform(0, usual_s), 0


def _child(output: Path, options: dict[str, Any], call: int = 0) -> Any:
    """A process that reconstructs, forked from one that has only imported what it needs."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["freeocc3d.pipeline.run", "fuzz.checkpoints"])
    process = context.Process(target=_work, args=(output, options, call))
    process.start()
    return process


def _work(output: Path, options: dict[str, Any], call: int) -> None:
    if call:
        sys.addaudithook(_Killer(call))
    _reconstruct(output, **options)


class _Killer:
    """Kills its process before the n-th change of a name while the run finishes."""

    EVENTS = ("os.rename", "os.remove", "os.rmdir", "shutil.rmtree", "ctypes.dlopen")

    def __init__(self, call: int):
        self.left, self.finishing = call, False

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event not in self.EVENTS:
            return
        if event == "os.rename" and str(arguments[1]).endswith("stages.json"):
            with open(arguments[0], "rb") as stream:
                self.finishing = b'"map":' in stream.read()
        if self.finishing:
            self.left -= 1
            if self.left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
