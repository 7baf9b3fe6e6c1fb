"""The folder ``MAP.partial`` of a run in progress: the result of each stage, and whether a resumed run can use it."""

from __future__ import annotations

import contextlib
import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import is_whole, read_arrays, write_arrays
from ..core.atomic_files import exchange, is_temporary, replace_text, sync
from ..core.checksums import hash_file, seal, unseal
from ..core.errors import MapError
from ..core.progress import Progress
from ..core.regular_files import read_bytes
from ..core.types import Gaussians
from ..core.warnings import Notice, read_notices
from ..gaussians.point_cloud import read_gaussian_ply, write_gaussian_ply
from ..settings import config
from ..settings.config import Settings
from . import map_files
from .live_snapshot import SNAPSHOT, WATCHED
from .manifest import read_manifest
from .output_folder import follow_link, refuse_output
from .run_lock import LOCK, RunLock

Stage = Literal["tracking", "gaussians", "language", "map"]

STAGES: dict[Stage, tuple[str, ...]] = {
    "tracking": ("capture", "tracking"),
    "gaussians": ("capture", "tracking", "gaussians", "fitting", "occupancy"),
    "language": ("capture", "tracking", "gaussians", "fitting", "occupancy", "language"),
    "map": ("capture", "tracking", "gaussians", "fitting", "occupancy", "language", "vocabulary", "carving"),
}
"""Stages whose results are saved, and the configuration sections on which they depend. "map" is the whole map, which
only lacks its name."""

_TRACKING = ("tracking.a.npz", "tracking.b.npz")
"""Layer 1's checkpoints take turns, so that the last one is whole while the next one is written."""

_STAGE_FEATURES, _MARKS = "features.stage.npz", "stages.json"
_ANSWERS, _OFFLINE = "vocabulary.stage.json", "offline"
_STAGE_FILES = (*_TRACKING, _STAGE_FEATURES, _ANSWERS)
_OWN_FILES = {
    *_STAGE_FILES, _MARKS, LOCK, _OFFLINE, map_files.MANIFEST, map_files.KEYFRAMES, *map_files.ALWAYS,
    *map_files.PICTURES, map_files.OBJECTS, SNAPSHOT, WATCHED,
}  # fmt: skip
_LARGEST_MARKS = 1 << 20


class _Mark(msgspec.Struct):
    """A saved stage. inputs: fingerprint of what it depends on.  files: name -> checksum of its result."""

    inputs: str
    files: dict[str, str]


class WorkFolder:
    """The folder ``MAP.partial`` of a run in progress: locked, with checkpoints, each with what it depends on and the
    checksums of its files. A file is on the disk before its stage is marked as saved."""

    def __init__(self, folder: Path, lock: RunLock, resumed: bool):
        self.folder = folder
        self.resumed = resumed
        self.seconds: dict[str, float] = {}
        self.warnings: list[Notice] = []
        self.broken: dict[int, str] = {}  # frame -> what is wrong with it
        self._lock = lock
        self._stage, self._since = "", 0.0
        self._fingerprints: dict[Stage, str] = {}
        self._marks: dict[Stage, _Mark] = {}

    @classmethod
    def open(cls, output: Path, overwrite: bool, resume: bool) -> WorkFolder:
        """Lock the work folder of a map; change nothing else but what a killed run forgot to clean up. A link to a map
        stands for that map. Raises MapError if a map, an interrupted run or a running one is in the way."""
        output = follow_link(output)
        if not output.name:
            raise MapError(f"'{output}' cannot be the name of a map folder.")
        folder = output.with_name(output.name + ".partial")
        refuse_output(output, overwrite)
        _refuse_strange(folder)
        try:
            lock = RunLock(folder)
        except OSError as error:
            raise MapError(f"Cannot create {folder}: {error.strerror}.") from error
        try:
            _put_back(output)
            refuse_output(output, overwrite)
            if (folder / _MARKS).is_file() and not (resume or overwrite):
                raise MapError(
                    f"{folder} holds the work of an interrupted run: continue with --resume, or start again with "
                    "--overwrite."
                )
            return cls(folder, lock, resume and (folder / _MARKS).is_file())
        except BaseException:
            lock.release()
            _drop_if_empty(folder)
            raise

    @classmethod
    @contextlib.contextmanager
    def made_of(cls, source: Path, output: Path, overwrite: bool) -> Iterator[WorkFolder]:
        """The empty work folder of a map that is made from another map. Removed at the end, unless ``finish`` gave it
        the map's name. Raises MapError as ``open`` does, if the output is the source's own folder, and if it cannot be
        written."""
        if output.resolve() == source.resolve():
            raise MapError(f"A map made from {source} cannot replace it: choose another folder.")
        work = cls.open(output, overwrite, resume=False)
        try:
            work._clear()
            yield work
        except OSError as error:
            raise MapError(f"Cannot write {output}: {error.strerror}.") from error
        finally:
            work.discard()

    def begin(self, identity: list[Any], settings: Settings, progress: Progress) -> None:
        """Find the saved stages that are valid for this configuration and input, and whose files are whole; without
        ``resumed``, empty the folder. identity: describes the input. Warns of damaged files. Raises MapError, and
        changes nothing, if the resumed run had another input or other tracking options."""
        relevant = settings.changed("capture", max_broken=0.0)  # a resumed run may have another
        self._fingerprints = {
            stage: config.fingerprint(relevant, sections, identity) for stage, sections in STAGES.items()
        }
        if not self.resumed:
            self._clear()
            return
        self._drop_special_files()
        try:
            saved = _read_marks(self.folder / _MARKS)
        except (OSError, ValueError):
            self._warn_of_damage(progress, self.folder / _MARKS, "the run starts again")
            self._clear()
            return
        if saved.get("tracking", _Mark("", {})).inputs != self._fingerprints["tracking"]:
            raise MapError(
                f"{self.folder} was started with another capture, or other capture or tracking options: resume "
                "with the same ones, or start again with --overwrite."
            )
        for stage, mark in saved.items():
            if mark.inputs != self._fingerprints[stage]:
                continue
            damaged = self._damaged(mark)
            if damaged is None:
                self._marks[stage] = mark
            else:
                self._warn_of_damage(progress, damaged, f"the stage '{stage}' runs again")

    @property
    def complete(self) -> bool:
        """Whether the map of this configuration is saved, whole, and only lacks its name."""
        if "map" not in self._marks:
            return False
        try:
            files = read_manifest(self.folder).checksums or {}
            return all(hash_file(self.folder / name) == checksum for name, checksum in files.items())
        except (OSError, MapError):
            return False

    def _damaged(self, mark: _Mark) -> Path | None:
        """The first file of a stage that is missing or not as it was written."""
        for name, checksum in mark.files.items():
            try:
                if hash_file(self.folder / name) == checksum:
                    continue
            except OSError:
                pass
            return self.folder / name
        return None

    def _warn_of_damage(self, progress: Progress, path: Path, then: str) -> None:
        self.warn(progress, Notice("checkpoint-damaged", f"{path} is missing or damaged, so {then}."))

    def _drop_special_files(self) -> None:
        """Remove links, pipes and devices: writing to them would block, or change what lies elsewhere."""
        for path in list(self.folder.rglob("*")):
            if path.is_symlink() or not (path.is_file() or path.is_dir()):
                path.unlink()

    def _clear(self) -> None:
        """Empty the folder. Raises MapError."""
        try:
            for path in self.folder.iterdir():
                if path.name == LOCK:
                    continue
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink()
        except OSError as error:
            raise MapError(f"Cannot empty {self.folder}: {error.strerror}.") from error

    def save_tracking(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Save layer 1's state in place of the last one."""
        seconds = {**self.seconds, self._stage: self.seconds.get(self._stage, 0.0) + time.perf_counter() - self._since}
        log = {"broken": self.broken, "warnings": [notice.to_dict() for notice in self.warnings], "seconds": seconds}
        name = _TRACKING[_TRACKING[0] in self._tracking_files]
        write_arrays(self.folder / name, {**state, "log": np.array(json.dumps(log))})
        self._mark("tracking", name)

    def restore_tracking(self) -> dict[str, NDArray[Any]] | None:
        """The state of the last checkpoint; None if there is no valid one."""
        for name in self._tracking_files:
            with np.load(self.folder / name, allow_pickle=False) as arrays:
                state = dict(arrays)
            log = json.loads(str(state.pop("log")))
            self.broken = {int(index): text for index, text in log["broken"].items()}
            damage = [notice for notice in self.warnings if notice.code == "checkpoint-damaged"]
            self.warnings = [*read_notices(log["warnings"]), *damage]
            self.seconds = {name: self.seconds.get(name, 0.0) + value for name, value in log["seconds"].items()}
            return state
        return None

    @property
    def _tracking_files(self) -> list[str]:
        """The last checkpoint of layer 1, if there is one."""
        return list(self._marks["tracking"].files) if "tracking" in self._marks else []

    def gaussians(self, compute: Callable[[], Gaussians]) -> Gaussians:
        """The saved result of layer 2, or else ``compute()``, which is then saved."""
        path = self.folder / map_files.GAUSSIANS
        if "gaussians" in self._marks:
            return read_gaussian_ply(path)
        result = compute()
        if len(result):
            write_gaussian_ply(result, path)
            self._mark("gaussians", path.name)
        return result

    def features(self, compute: Callable[[], NDArray[np.float16]]) -> NDArray[np.float16]:
        """The saved result of layer 3, or else ``compute()``, which is then saved."""
        path = self.folder / _STAGE_FEATURES
        if "language" in self._marks:
            return np.asarray(read_arrays(path, {"features": ("f", 2)})["features"], np.float16)
        features = compute()
        write_arrays(path, {"features": features})
        self._mark("language", path.name)
        return features

    @property
    def kept(self) -> bool:
        """Whether the folder holds a result or checkpoint from which a run can resume."""
        return (self.folder / _MARKS).is_file()

    @property
    def answers(self) -> Path:
        """The file of answers about keyframes; each answer states its question."""
        return self.folder / _ANSWERS

    def warn(self, progress: Progress, *notices: Notice) -> None:
        """Show the notices now, and keep them for the map's report."""
        for notice in notices:
            self.warnings.append(notice)
            progress.warn(notice.text)

    def begin_offline(self) -> Path:
        """The folder for what a tracker computes of the whole scan before its first frame. From now on the run can be
        resumed; the content of the folder says how far it is. Damaged files are removed from it."""
        folder = self.folder / _OFFLINE
        folder.mkdir(exist_ok=True)
        for path in folder.rglob("*.npz"):
            if not is_whole(path):
                path.unlink()
        if "tracking" not in self._marks:
            self._mark("tracking")
        return folder

    def mark_complete(self) -> None:
        """Record that the map is whole: from now on a resumed run only gives it its name. Raises OSError."""
        files = read_manifest(self.folder).files
        for folder in {(self.folder / name).parent for name in files}:
            sync(folder)
        self._mark("map", map_files.MANIFEST)

    def finish(self, output: Path) -> None:
        """Give the work folder the map's name; a link stands for what it leads to. At every moment the folder of that
        name is the old or the new map, and the work can be resumed until it is the new one. Raises OSError."""
        output = follow_link(output)
        listed = {map_files.MANIFEST, *read_manifest(self.folder).files}
        for path in self.folder.rglob("*"):
            name = path.relative_to(self.folder).as_posix()
            if not (name in listed or name in (_MARKS, LOCK) or path.is_dir()):
                path.unlink()
        shutil.rmtree(self.folder / _OFFLINE, ignore_errors=True)
        if not output.exists():
            self.folder.rename(output)
            old = None
        else:
            _drop_leftovers(output)
            old = self._replace(output)
        (output / WATCHED).unlink(missing_ok=True)  # set after the cleaning above
        sync(output.absolute().parent)
        self._lock.folder = output
        _drop_leftovers(output)
        self._lock.release()
        if old is not None:
            shutil.rmtree(old, ignore_errors=True)

    def _replace(self, output: Path) -> Path:
        """Let the work folder and the map of that name change places. Returns the old map's folder."""
        if exchange(self.folder, output):
            return self.folder
        aside = _aside(output)
        output.rename(aside)
        try:
            self.folder.rename(output)
        except BaseException:
            aside.rename(output)
            raise
        return aside

    def discard(self) -> None:
        """Remove the folder of a run that cannot lead to a map, unless it has the map's name by now."""
        if self._lock.folder == self.folder:
            shutil.rmtree(self.folder, ignore_errors=True)
        self.close()

    def close(self) -> None:
        """Let other runs use the folder. Removes it if it is empty."""
        self._lock.release()
        _drop_if_empty(self.folder)

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time spent inside to the seconds of the stage."""
        self._stage, self._since = stage, time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - self._since

    def _mark(self, stage: Stage, *names: str) -> None:
        """Record that a stage's result is saved in files of these names. Results of later stages become invalid."""
        order = list(STAGES)
        files = {}
        for name in names:
            sync(self.folder / name)
            files[name] = hash_file(self.folder / name)
        kept = {name: mark for name, mark in self._marks.items() if order.index(name) < order.index(stage)}
        self._marks = {**kept, stage: _Mark(self._fingerprints[stage], files)}
        sync(self.folder)
        replace_text(self.folder / _MARKS, seal(json.dumps(msgspec.to_builtins(self._marks))))


def _read_marks(path: Path) -> dict[Stage, _Mark]:
    """The saved stages. Raises OSError, ValueError."""
    return msgspec.json.decode(unseal(read_bytes(path, _LARGEST_MARKS)), type=dict[Stage, _Mark])


def _refuse_strange(folder: Path) -> None:
    """Raise MapError if the folder is there but holds other things than an interrupted run."""
    if not (folder.exists() or folder.is_symlink()):
        return
    known = (
        not folder.is_symlink()
        and folder.is_dir()
        and all(path.name in _OWN_FILES or is_temporary(path) for path in folder.iterdir())
    )
    if not known:
        raise MapError(f"{folder} is in the way and holds no interrupted run: move it, or choose another.")


def _aside(output: Path) -> Path:
    """Where the old map waits while the new one takes its name, on file systems that cannot exchange two folders."""
    return output.with_name(f".{output.name}.replaced")


def _put_back(output: Path) -> None:
    """Undo or finish what a killed run left when it gave the new map its name. Raises OSError."""
    if output.is_dir():
        _drop_leftovers(output)
    if (aside := _aside(output)).is_dir():
        if output.exists():
            shutil.rmtree(aside)
        else:
            aside.rename(output)


def _drop_leftovers(output: Path) -> None:
    """Remove what a run keeps in its work folder besides the map."""
    for name in (_MARKS, LOCK):
        (output / name).unlink(missing_ok=True)


def _drop_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()
