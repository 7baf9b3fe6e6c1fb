"""The work folder of a run: marks with checksums, damaged checkpoints, and how a map gets its name."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from pipeline_runs import ROOM, content, listing, notices

import freeocc3d
from freeocc3d.core.errors import Interrupted, MapError
from freeocc3d.core.progress import Progress
from freeocc3d.storage import work_folder
from freeocc3d.storage.work_folder import WorkFolder

FEW = {"capture": {**ROOM["capture"], "stop": 6}, "fitting": {"passes": 0}}


class Killed(BaseException):
    """Stands for the end of the process: nothing handles it but what a dying process would not do either."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The map of an uninterrupted run."""
    return freeocc3d.reconstruct("builtin:room", tmp_path_factory.mktemp("whole") / "map", FEW).path


class Stop(Progress):
    """Ctrl-C when a stage begins."""

    def __init__(self, stage: str):
        self.target = stage

    def stage(self, name, total=None) -> None:
        if name == self.target:
            raise KeyboardInterrupt


@pytest.fixture(scope="module")
def stopped(tmp_path_factory) -> Path:
    """The work folder of a run that ended in layer 4."""
    output = tmp_path_factory.mktemp("stopped") / "map"
    with pytest.raises(Interrupted):
        freeocc3d.reconstruct("builtin:room", output, FEW, progress=Stop("occupancy"))
    return output.with_name("map.partial")


@pytest.fixture(scope="module")
def complete(tmp_path_factory) -> Path:
    """The work folder of a run that ended when its map was whole and only lacked its name."""

    def stop(self, output) -> None:
        raise KeyboardInterrupt

    output = tmp_path_factory.mktemp("complete") / "map"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(WorkFolder, "finish", stop)
        with pytest.raises(Interrupted):
            freeocc3d.reconstruct("builtin:room", output, FEW)
    return output.with_name("map.partial")


def resume(tmp_path: Path):
    return freeocc3d.reconstruct("builtin:room", tmp_path / "map", FEW, resume=True)


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[2 * len(data) // 3] ^= 4
    path.write_bytes(data)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


HARMLESS = ["tracking.a.npz", "keyframes/000000.color.jpg", "keyframes/000000.depth.png"]
"""An older checkpoint, and what is written again from the capture."""
FILES = [*HARMLESS, "tracking.b.npz", "gaussians.ply", "features.stage.npz", "stages.json"]


@pytest.mark.parametrize(
    ("name", "damage"), [*zip(FILES, [flip, cut, Path.unlink] * 3, strict=False), ("stages.json", cut)]
)
def test_a_damaged_checkpoint_is_made_again(tmp_path, stopped, whole, name, damage) -> None:
    work = shutil.copytree(stopped, tmp_path / "map.partial")
    damage(work / name)
    made = resume(tmp_path)
    assert content(made.path) == content(whole)
    said = [notice.text for notice in notices(made) if notice.code == "checkpoint-damaged"]
    assert [name in text for text in said] == ([] if name in HARMLESS else [True])


def test_a_second_run_is_refused_while_the_first_works(tmp_path) -> None:
    refused = []

    class Second(Progress):
        def stage(self, name, total=None) -> None:
            for options in ({}, {"resume": True}, {"overwrite": True}):
                with pytest.raises(MapError, match=f"in use: another run .process {os.getpid()} on") as error:
                    freeocc3d.reconstruct("builtin:room", tmp_path / "map", FEW, **options)
                refused.append(str(error.value))

    freeocc3d.reconstruct("builtin:room", tmp_path / "map", FEW, progress=Second())
    assert len(refused) > 10
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


@pytest.mark.parametrize(("existing", "exchanging"), [(True, True), (True, False), (False, True)])
def test_at_every_moment_of_finishing_there_is_a_whole_map_or_work_to_resume(
    tmp_path, complete, whole, monkeypatch, existing, exchanging
) -> None:
    """Finishing is stopped before each call that changes a name, one more at a time."""
    if not exchanging:
        monkeypatch.setattr(work_folder, "exchange", lambda one, other: False)
    old = {**FEW, "capture": {**FEW["capture"], "stop": 4}}
    before = freeocc3d.reconstruct("builtin:room", tmp_path / "old", old).path if existing else None
    for allowed in range(100):
        place = tmp_path / str(allowed)
        shutil.copytree(complete, place / "map.partial")
        if before is not None:
            shutil.copytree(before, place / "map")
        if _finish_until(allowed, place / "map", monkeypatch):
            break
        if before is not None and (exchanging or (place / "map").exists()):
            assert _but_leftovers(place / "map") in (content(before), content(whole))
            freeocc3d.load_map(place / "map")
        elif before is not None:
            assert content(place / ".map.replaced") == content(before)
        resumable = (place / "map.partial" / "stages.json").exists()
        assert resumable or _but_leftovers(place / "map") == content(whole)
        options: dict[str, bool] = {"resume": True, "overwrite": True}
        assert content(freeocc3d.reconstruct("builtin:room", place / "map", FEW, **options).path) == content(whole)
        assert [path.name for path in place.iterdir()] == ["map"]
        assert not {"lock", "stages.json"} & set(listing(place / "map"))
    assert allowed > 8


def _but_leftovers(folder: Path) -> dict[str, bytes]:
    return {name: data for name, data in content(folder).items() if name not in ("lock", "stages.json")}


def _finish_until(allowed: int, output: Path, monkeypatch) -> bool:
    """Resume a run, and end it at a change of a name after ``allowed`` ones in ``finish``. Whether there were fewer."""
    count = 0

    def limited(original):
        def call(*arguments, **options):
            nonlocal count
            count += 1
            if count > allowed:
                raise Killed
            return original(*arguments, **options)

        return call

    def finish(self, output: Path) -> None:
        with monkeypatch.context() as patched:
            for name in ("rename", "unlink"):
                patched.setattr(Path, name, limited(getattr(Path, name)))
            for name in ("unlink", "rmdir"):  # of shutil.rmtree
                patched.setattr(os, name, limited(getattr(os, name)))
            patched.setattr(work_folder, "exchange", limited(work_folder.exchange))
            original(self, output)

    original = WorkFolder.finish
    with monkeypatch.context() as patched:
        patched.setattr(WorkFolder, "finish", finish)
        patched.setattr(WorkFolder, "close", lambda self: os.close(self._lock._descriptor))
        try:
            freeocc3d.reconstruct("builtin:room", output, FEW, resume=True, overwrite=True)
        except Killed:
            return False
        except OSError:  # the lock's descriptor is closed already
            return True
    return True


def test_what_is_no_file_in_a_work_folder_is_replaced(tmp_path, stopped, whole) -> None:
    work = shutil.copytree(stopped, tmp_path / "map.partial")
    (tmp_path / "precious").write_text("mine")
    for name in ("gaussians.ply", "keyframes/000000.color.jpg"):
        (work / name).unlink()
        os.mkfifo(work / name)
    for name in ("report.json", "keyframes/000000.depth.png", "offline"):
        (work / name).unlink(missing_ok=True)
        (work / name).symlink_to(tmp_path / "precious")
    os.mkfifo(work / "gaussians.png")
    assert content(resume(tmp_path).path) == content(whole)
    assert (tmp_path / "precious").read_text() == "mine"


def test_a_complete_map_that_was_damaged_before_it_got_its_name_is_made_again(tmp_path, complete, whole) -> None:
    work = shutil.copytree(complete, tmp_path / "map.partial")
    flip(work / "occupancy.npz")
    assert content(resume(tmp_path).path) == content(whole)


def test_a_stopped_run_goes_on_with_other_options_of_later_layers(tmp_path, complete) -> None:
    shutil.copytree(complete, tmp_path / "map.partial")
    other = {**FEW, "carving": {"noise": 0.02}}
    made = freeocc3d.reconstruct("builtin:room", tmp_path / "map", other, resume=True)
    assert content(made.path) == content(freeocc3d.reconstruct("builtin:room", tmp_path / "anew", other).path)


def test_a_link_stands_for_the_map_to_which_it_leads(tmp_path, whole) -> None:
    disk = tmp_path / "disk"
    shutil.copytree(whole, disk / "stored")
    (tmp_path / "map").symlink_to(disk / "stored")
    other = {**FEW, "capture": {**FEW["capture"], "stop": 4}}
    with pytest.raises(MapError, match="--overwrite"):
        freeocc3d.reconstruct("builtin:room", tmp_path / "map", other)
    made = freeocc3d.reconstruct("builtin:room", tmp_path / "map", other, overwrite=True)
    assert made.manifest.counts.frames_with_pose == 4
    assert (tmp_path / "map").is_symlink()
    assert sorted(path.name for path in (*tmp_path.iterdir(), *disk.iterdir())) == ["disk", "map", "stored"]
    assert freeocc3d.load_map(disk / "stored").manifest.counts.frames_with_pose == 4


def test_links_that_lead_nowhere_or_stand_for_the_work_are_refused(tmp_path, stopped) -> None:
    (tmp_path / "one").symlink_to(tmp_path / "other")
    (tmp_path / "other").symlink_to(tmp_path / "one")
    with pytest.raises(MapError, match="a link that leads nowhere"):
        freeocc3d.reconstruct("builtin:room", tmp_path / "one", FEW)
    (tmp_path / "map.partial").symlink_to(stopped)
    before = listing(stopped)
    for options in ({"resume": True}, {"overwrite": True}):
        with pytest.raises(MapError, match="in the way"):
            freeocc3d.reconstruct("builtin:room", tmp_path / "map", FEW, **options)
    assert listing(stopped) == before
