"""The folder ``MAP.partial`` of a run in progress: the result of each stage, and whether a resumed run can use it."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import read_arrays, write_arrays
from ..core.atomic_files import is_temporary, replace_text
from ..core.errors import MapError
from ..core.progress import Progress
from ..core.types import Gaussians
from ..core.warnings import Notice, read_notices
from ..gaussians.point_cloud import read_gaussian_ply, write_gaussian_ply
from ..settings import config
from ..settings.config import Settings
from . import map_files

Stage = Literal["tracking", "gaussians", "language"]

STAGES: dict[Stage, tuple[str, ...]] = {
    "tracking": ("capture", "tracking"),
    "gaussians": ("capture", "tracking", "gaussians", "fitting", "occupancy"),
    "language": ("capture", "tracking", "gaussians", "fitting", "occupancy", "language"),
}
"""Stages whose results are saved, and the configuration sections on which they depend."""

_TRACKING, _STAGE_FEATURES, _MARKS = "tracking.npz", "features.stage.npz", "stages.json"
_ANSWERS, _OFFLINE = "vocabulary.stage.json", "offline"
_STAGE_FILES = (_TRACKING, _STAGE_FEATURES, _ANSWERS, _MARKS)
_OWN_FILES = {
    *_STAGE_FILES, _OFFLINE, map_files.MANIFEST, map_files.KEYFRAMES, *map_files.ALWAYS, *map_files.PICTURES,
}  # fmt: skip


class WorkFolder:
    """The folder ``MAP.partial`` of a run in progress: checkpoints, and the fingerprint of what they depend on."""

    def __init__(self, folder: Path, resumed: bool):
        self.folder = folder
        self.resumed = resumed
        self.seconds: dict[str, float] = {}
        self.warnings: list[Notice] = []
        self.broken: dict[int, str] = {}  # frame -> what is wrong with it
        self._stage, self._since = "", 0.0
        self._fingerprints: dict[Stage, str] = {}
        self._valid: set[Stage] = set()

    @classmethod
    def open(cls, output: Path, overwrite: bool, resume: bool) -> WorkFolder:
        """Open the work folder of a map; change nothing on disk. Raises MapError if a map or an interrupted run is in
        the way."""
        if not output.name:
            raise MapError(f"'{output}' cannot be the name of a map folder.")
        folder = output.with_name(output.name + ".partial")
        if output.exists() and not overwrite:
            raise MapError(f"{output} exists: choose another folder, or replace it with --overwrite.")
        if output.exists() and not (output / map_files.MANIFEST).is_file():
            raise MapError(f"{output} is not a map, so it is not overwritten: choose another folder.")
        if folder.exists():
            strange = folder.is_file() or any(
                path.name not in _OWN_FILES and not is_temporary(path) for path in folder.iterdir()
            )
            if strange:
                raise MapError(f"{folder} is in the way and holds no interrupted run: move it, or choose another.")
            if (folder / _MARKS).is_file() and not (resume or overwrite):
                raise MapError(
                    f"{folder} holds the work of an interrupted run: continue with --resume, or start again with "
                    "--overwrite."
                )
        return cls(folder, resume and (folder / _MARKS).is_file())

    @classmethod
    def made_of(cls, source: Path, output: Path, overwrite: bool) -> WorkFolder:
        """The work folder of a map that is made from another map. Raises MapError as ``open`` does, and if the output
        is the source's own folder."""
        if output.resolve() == source.resolve():
            raise MapError(f"A map made from {source} cannot replace it: choose another folder.")
        return cls.open(output, overwrite, resume=False)

    @contextlib.contextmanager
    def begun_anew(self, output: Path) -> Iterator[None]:
        """Make an empty folder, and remove it if writing ``output`` fails. Raises MapError then."""
        try:
            self._make()
            yield
        except BaseException as error:
            self.discard()
            if isinstance(error, OSError):
                raise MapError(f"Cannot write {output}: {error.strerror}.") from error
            raise

    def begin(self, identity: list[Any], settings: Settings) -> None:
        """Make the folder, and find the saved stages that are valid for this configuration and input. identity:
        describes the input. Raises MapError, and changes nothing, if the resumed run had another input or other
        tracking options."""
        relevant = settings.changed("capture", max_broken=0.0)  # a resumed run may have another
        self._fingerprints = {
            stage: config.fingerprint(relevant, sections, identity) for stage, sections in STAGES.items()
        }
        if self.resumed:
            saved = self._read_marks()
            self._valid = {stage for stage, value in self._fingerprints.items() if saved.get(stage) == value}
            if "tracking" not in self._valid:
                raise MapError(
                    f"{self.folder} was started with another capture, or other capture or tracking options: resume "
                    "with the same ones, or start again with --overwrite."
                )
            return
        self._make()

    def _make(self) -> None:
        """Make the folder, empty. Raises MapError."""
        if self.folder.exists():
            shutil.rmtree(self.folder)
        try:
            self.folder.mkdir(parents=True)
        except OSError as error:
            raise MapError(f"Cannot create {self.folder}: {error.strerror}.") from error

    def save_tracking(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Save layer 1's state in place of the last one."""
        seconds = {**self.seconds, self._stage: self.seconds.get(self._stage, 0.0) + time.perf_counter() - self._since}
        log = {"broken": self.broken, "warnings": [notice.to_dict() for notice in self.warnings], "seconds": seconds}
        write_arrays(self.folder / _TRACKING, {**state, "log": np.array(json.dumps(log))})
        self._mark("tracking")

    def restore_tracking(self) -> dict[str, NDArray[Any]] | None:
        """The state of the last checkpoint; None if there is no valid one."""
        path = self.folder / _TRACKING
        if "tracking" not in self._valid or not path.is_file():
            return None
        state = read_arrays(path, {})
        log = json.loads(str(state.pop("log")))
        self.broken = {int(index): text for index, text in log["broken"].items()}
        self.warnings = read_notices(log["warnings"])
        self.seconds = {name: self.seconds.get(name, 0.0) + value for name, value in log["seconds"].items()}
        return state

    def forget_tracking(self) -> None:
        """Remove layer 1's checkpoint: a run that resumes from here tracks again from the start."""
        (self.folder / _TRACKING).unlink(missing_ok=True)

    def gaussians(self, compute: Callable[[], Gaussians]) -> Gaussians:
        """The saved result of layer 2, or else ``compute()``, which is then saved."""
        path = self.folder / map_files.GAUSSIANS
        if "gaussians" in self._valid and path.is_file():
            return read_gaussian_ply(path)
        result = compute()
        if len(result):
            write_gaussian_ply(result, path)
            self._mark("gaussians")
        return result

    def features(self, compute: Callable[[], NDArray[np.float16]]) -> NDArray[np.float16]:
        """The saved result of layer 3, or else ``compute()``, which is then saved."""
        path = self.folder / _STAGE_FEATURES
        if "language" in self._valid and path.is_file():
            return np.asarray(read_arrays(path, {"features": ("f", 2)})["features"], np.float16)
        features = compute()
        write_arrays(path, {"features": features})
        self._mark("language")
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
        resumed; the content of the folder says how far it is."""
        (self.folder / _OFFLINE).mkdir(exist_ok=True)
        if "tracking" not in self._valid:
            self._mark("tracking")
        return self.folder / _OFFLINE

    def finish(self, output: Path) -> None:
        """Give the work folder the map's name. A map that it replaces is removed only when that has succeeded."""
        for path in self.folder.iterdir():
            if path.name in _STAGE_FILES or is_temporary(path):
                path.unlink()
        shutil.rmtree(self.folder / _OFFLINE, ignore_errors=True)
        if not output.exists():
            self.folder.rename(output)
            return
        aside = Path(tempfile.mkdtemp(prefix=f".{output.name}.", dir=output.parent)) / output.name
        output.rename(aside)
        try:
            self.folder.rename(output)
        except OSError:
            aside.rename(output)
            raise
        finally:
            shutil.rmtree(aside.parent, ignore_errors=True)

    def discard(self) -> None:
        """Remove the folder of a run that cannot lead to a map."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def drop_if_empty(self) -> None:
        """Remove the folder if it is empty."""
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time spent inside to the seconds of the stage."""
        self._stage, self._since = stage, time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - self._since

    def _read_marks(self) -> dict[str, str]:
        """Fingerprint of each stage whose result is saved. Raises MapError."""
        try:
            saved = json.loads((self.folder / _MARKS).read_text(encoding="utf-8"))
            return {str(stage): str(value) for stage, value in saved.items()}
        except (OSError, ValueError, AttributeError) as error:
            raise MapError(f"Cannot read {self.folder / _MARKS}: start again with --overwrite.") from error

    def _mark(self, stage: Stage) -> None:
        """Record that a stage's result is saved. Results of later stages become invalid."""
        order = list(STAGES)
        self._valid = {name for name in self._valid if order.index(name) < order.index(stage)} | {stage}
        marks = {name: self._fingerprints[name] for name in self._valid}
        replace_text(self.folder / _MARKS, json.dumps(marks))
