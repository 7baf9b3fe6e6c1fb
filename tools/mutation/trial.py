"""Tries one changed module: its tests run in a child process, in a copy of the project."""

from __future__ import annotations

import importlib
import json
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from .project import Project

_WARM = {"numpy", "numba", "scipy.ndimage", "scipy.spatial", "scipy.optimize", "cv2", "torch", "open3d", "pytest"}
"""Imported once, if the package does, before the children fork; what is changed is imported by the children alone."""
_COPIED = ("setup.cfg", "pyproject.toml", "tests", "tools", "configs")
_COMPILING_S = 90
_NOTHING_RAN = 5  # for pytest: every test of the file is skipped as a whole
_MEMORY = 8 << 30
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Outcome(NamedTuple):
    """How the tests ended. code: of pytest, None for a crash or too long.  cpu_s: of the child."""

    code: int | None
    cpu_s: float

    @property
    def passed(self) -> bool:
        """Whether no test failed."""
        return self.code in (0, _NOTHING_RAN)


class Copies:
    """Copies of a project below a folder. One is warm: its tests have run, so that its kernels are compiled. A folder
    of an earlier run is brought up to date, and its times are used again unless the package or the test changed."""

    def __init__(self, project: Project, folder: Path) -> None:
        self.project, self.folder = project, folder
        self.warm = folder / "warm"
        self._known = folder / "times.json"
        changed = self._update()
        times = json.loads(self._known.read_text(encoding="utf-8")) if self._known.exists() else {}
        if any(name.split("/")[0] == project.package for name in changed):
            times = {}
        self._times = {name: seconds for name, seconds in times.items() if name not in changed}
        self._failing: set[str] = set()

    def _update(self) -> set[str]:
        """Returns the names of the files that were copied or removed."""
        root, changed = self.project.root, set()
        wanted = {name for top in (self.project.package, *_COPIED) for name in _files(root, top)}
        for name in wanted | {name for top in (self.project.package, *_COPIED) for name in _files(self.warm, top)}:
            source, copy = root / name, self.warm / name
            if name in wanted and copy.exists() and source.read_bytes() == copy.read_bytes():
                continue
            copy.unlink(missing_ok=True)
            changed.add(name)
            if name in wanted:
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(source, copy)
        for name in changed:
            module = name.removeprefix(f"{self.project.package}/").removesuffix(".py")
            self._forget(self.warm, self.project.kernels_with(module))
        return changed

    def _forget(self, root: Path, modules: Iterable[str]) -> None:
        for module in modules:
            path = root / self.project.package / module
            for compiled in path.parent.glob(f"__pycache__/{path.name}.*.nb?"):
                compiled.unlink()

    def passing(self, tests: Sequence[Path]) -> list[Path]:
        """The test files that pass as they are; each is run once, which compiles kernels. Others are told on stderr."""
        for path in tests:
            name = self._name(path)
            if name not in self._times and name not in self._failing:
                outcome = wait(start(self.warm, [name], 1800))
                if outcome.passed:
                    self._times[name] = outcome.cpu_s
                    self._known.write_text(json.dumps(self._times), encoding="utf-8")
                else:
                    self._failing.add(name)
                    said = _output_of(self.warm).read_text(encoding="utf-8")
                    print(f"{name} fails without any change and is left out:\n{said}", file=sys.stderr, flush=True)
        return [path for path in tests if self._name(path) in self._times]

    def _name(self, test: Path) -> str:
        return test.relative_to(self.project.root).as_posix()

    def start(self, module: str, source: str, tests: Sequence[Path], folder: Path) -> tuple[int, float]:
        """Starts the ``passing`` tests of a changed module in a new copy, the fastest first."""
        names = sorted(map(self._name, tests), key=lambda name: self._times[name])
        limit_s = 10 + 4 * sum(self._times[name] for name in names)
        shutil.copytree(self.warm, folder, symlinks=True, copy_function=os.link)
        path = folder / self.project.package / f"{module}.py"
        path.unlink()  # a link, of which the warm copy keeps the other end
        path.write_text(source, encoding="utf-8")
        if stale := {one for one in self.project.kernels_with(module) if self.project.has_kernels(one)}:
            limit_s += _COMPILING_S
            self._forget(folder, stale)
        return start(folder, names, limit_s)

    def drop(self, folder: Path) -> None:
        """Removes a copy."""
        shutil.rmtree(folder, ignore_errors=True)
        _output_of(folder).unlink(missing_ok=True)


def _files(root: Path, top: str) -> Iterator[str]:
    paths = [root / top] if (root / top).is_file() else (root / top).rglob("*")
    found = (path for path in paths if path.is_file() and "__pycache__" not in path.parts)
    yield from (path.relative_to(root).as_posix() for path in found)


def _output_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.txt")


def warm_up(project: Project) -> None:
    """Sets one thread and the lowest priority for the children, and imports what they need and what is not changed."""
    os.environ.update(_ONE_THREAD, PYTEST_DISABLE_PLUGIN_AUTOLOAD="1")
    os.nice(19)
    for name in sorted(_WARM & {"pytest", *project.foreign}):
        try:
            importlib.import_module(name)
        except ImportError:
            continue


def start(folder: Path, tests: Sequence[str], limit_s: float) -> tuple[int, float]:
    """Starts a child that runs test files of a copy. Returns its process and the time at which it has to end."""
    child = os.fork()
    if child:
        return child, time.monotonic() + 60 + 10 * limit_s  # other programs may be busy
    code = 99
    try:
        os.setsid()
        os.chdir(folder)
        sink = os.open(_output_of(folder), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(sink, stream)
        os.environ["PYTHONPATH"] = str(folder)
        sys.path[:] = [str(folder), *(path for path in sys.path if path not in ("", os.fspath(Path.cwd())))]
        seconds = max(1, int(limit_s))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
        resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY, _MEMORY))
        import pytest

        code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests]))
    finally:
        sys.stdout.flush()
        os._exit(code)


def wait(child: tuple[int, float]) -> Outcome:
    """Waits for a child, and ends it with all that it started when its time is up."""
    while (outcome := poll(child)) is None:
        time.sleep(0.02)
    return outcome


def poll(child: tuple[int, float]) -> Outcome | None:
    """How a child ended, None while it runs."""
    process, end = child
    late = time.monotonic() > end
    if late:
        os.killpg(process, signal.SIGKILL)
    ended, status, usage = os.wait4(process, 0 if late else os.WNOHANG)
    if not ended:
        return None
    code = os.waitstatus_to_exitcode(status)
    return Outcome(code if code >= 0 else None, usage.ru_utime + usage.ru_stime)
