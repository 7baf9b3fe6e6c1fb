"""Runs damaged inputs in child processes, and says how each ended.

A part is a module of this folder with two functions:

    prepare(folder)                    make the sound originals, once, in an empty folder
    attack(rng, originals, folder)     write one damaged input into the empty folder, and return an Attack

Everything random comes from ``rng``, whose seed is the run's seed, the part and the number of the input, so that each
input can be made again.
"""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import multiprocessing
import os
import random
import resource
import shutil
import signal
import stat
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
OUTCOMES = ("returned", "refused", "traceback", "crash", "hang", "memory", "silent")
SOUND = ("returned", "refused")

_RECYCLED_AFTER = 400
"""Inputs after which a process is replaced by a new one."""
_TICKS = os.sysconf("SC_CLK_TCK")


class Attack(NamedTuple):
    """One damaged input. description: one line that shows the mutation.  run: uses the input; may return, raise
    FreeOccError, or exit with 0, or with 1 or 2 and a sentence."""

    description: str
    run: Callable[[], object]


class Limits(NamedTuple):
    """What an input may take. hang_s: time on an idle machine, seconds.  endless_s: time on a busy one.  most_bytes: of
    memory.  runaway_bytes: of memory; beyond it, its process is ended at once."""

    hang_s: float = 20.0
    endless_s: float = 600.0
    most_bytes: int = 2 << 30
    runaway_bytes: int = 5 << 30


LIMITS = Limits()


class Silent(AssertionError):
    """A wrong answer without a word."""


class Result(NamedTuple):
    """How an input ended. detail: the sentence, or the last lines of the traceback."""

    part: str
    number: int
    outcome: str
    description: str
    detail: str
    seconds: float


def command(*arguments: object) -> None:
    """Run ``freeocc3d`` with these arguments in this process, as the command line does. Raises SystemExit."""
    from freeocc3d.cli.main import main

    main([str(argument) for argument in arguments])


def parts() -> list[str]:
    """The names of all parts."""
    others = {"__init__", "harness", "run"}
    files = (
        path
        for path in sorted(HERE.glob("*.py"))
        if path.stem not in others and not path.stem.startswith(("_", "test_"))
    )
    return [path.stem for path in files if "def attack(" in path.read_text(encoding="utf-8")]


def short_length(part: str) -> int:
    """How many inputs of a part the short run of the tests takes: what the part states as ``SHORT``, or 40."""
    lines = (HERE / f"{part}.py").read_text(encoding="utf-8").splitlines()
    stated = [line.partition("=")[2] for line in lines if line.startswith("SHORT =")]
    return int(stated[0]) if stated else 40


def run_part(
    part: str,
    numbers: range,
    seed: int = 0,
    jobs: int = 1,
    told: Callable[[Result], None] = lambda result: None,
    limits: Limits = LIMITS,
) -> list[Result]:
    """Run the inputs of a part with these numbers. told: is called with each result when it is there."""
    with tempfile.TemporaryDirectory(prefix=f"fuzz-{part}-", ignore_cleanup_errors=True) as root:
        originals = Path(root) / "originals"
        originals.mkdir()
        maker = _Worker(part, seed, originals, limits)
        made = maker.ask(-1)
        if made.outcome not in SOUND:
            maker.close()
            raise RuntimeError(f"The originals of {part} cannot be made: {made.outcome}: {made.detail}")
        queue = iter(numbers)

        def serve(worker: _Worker) -> list[Result]:
            results = []
            for number in _taken(queue):
                results.append(worker.ask(number))
                told(results[-1])
                if worker.spent:
                    worker.close()
                    worker = _Worker(part, seed, originals, limits)
            worker.close()
            return results

        workers = [maker, *(_Worker(part, seed, originals, limits) for _ in range(jobs - 1))]
        with ThreadPoolExecutor(jobs) as pool:
            found = [result for results in pool.map(serve, workers) for result in results]
    return sorted(found, key=lambda result: result.number)


def _taken(numbers: Iterator[int]) -> Iterator[int]:
    """The numbers that no other thread takes: ``next`` of a range's iterator is one step of the interpreter."""
    while (number := next(numbers, None)) is not None:
        yield number


@dataclass
class _Worker:
    """A child process that runs the inputs of one part, one after the other."""

    part: str
    seed: int
    originals: Path
    limits: Limits
    served: int = 0
    spent: bool = False
    """Whether it has died, or served long enough."""
    process: multiprocessing.process.BaseProcess = field(init=False)
    pipe: Connection = field(init=False)
    log: Path = field(init=False)

    def __post_init__(self) -> None:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["freeocc3d.pipeline.run", "freeocc3d.storage.writer"])
        self.pipe, other = context.Pipe()
        self.log = Path(tempfile.mkstemp(prefix="log-", dir=self.originals.parent)[1])
        arguments = (other, self.part, self.seed, self.originals, self.log, self.limits.most_bytes)
        self.process = context.Process(target=_serve, args=arguments, daemon=False)
        self.process.start()
        other.close()
        if not self.pipe.poll(self.limits.endless_s) or self.pipe.recv() != "ready":
            raise RuntimeError(f"A process for {self.part} does not start.")

    def ask(self, number: int) -> Result:
        """Run one input; number -1 makes the originals."""
        self.pipe.send(number)
        start = time.monotonic()
        problem = self._watch(self.limits.endless_s if number < 0 else self.limits.hang_s)
        seconds = time.monotonic() - start
        self.served += 1
        said: tuple[str, str, str] | None = None
        if not problem:
            try:
                said = self.pipe.recv()
            except (EOFError, OSError):
                self.process.join(30)
                problem = "crash"
        if said is None:
            self.spent = True
            return Result(self.part, number, problem, self._noted(), self._told(), seconds)
        outcome, description, detail = said
        self.spent = outcome == "memory" or self.served >= _RECYCLED_AFTER
        return Result(self.part, number, outcome, description, detail, seconds)

    def _watch(self, limit_s: float) -> str:
        """Wait for the answer: what is wrong if none comes. The time counts that the input would take on an idle
        machine: in which the process computes, or sleeps with no thread that could compute."""
        start = before = time.monotonic()
        own, computed = 0.0, sum(map(_computed_s, _family(self._pid)))
        while not self.pipe.poll(0.25):
            family = _family(self._pid)
            now, total = time.monotonic(), sum(map(_computed_s, family))
            asleep = all(map(_sleeps, family))
            own += now - before if asleep else max(0.0, min(total - computed, now - before))
            before, computed = now, total
            if own > limit_s or now - start > self.limits.endless_s:
                os.kill(self._pid, signal.SIGABRT)  # its handler writes where it is
                self.process.join(5)
                return "hang"
            if _resident_bytes(self._pid) > self.limits.runaway_bytes:
                self.process.kill()
                return "memory"
        return ""

    @property
    def _pid(self) -> int:
        return self.process.pid or 0

    def _noted(self) -> str:
        with contextlib.suppress(OSError):
            return self.log.with_suffix(".note").read_text(encoding="utf-8")
        return ""

    def _told(self) -> str:
        lines = self.log.read_bytes()[-8000:].decode("utf-8", "replace").strip().splitlines()
        tail = [line[:200] for line in lines if not line.startswith("Extension modules")][-16:]
        return "\n".join([f"exit {self.process.exitcode}", *tail])

    def close(self) -> None:
        """End the process."""
        with contextlib.suppress(OSError):
            self.pipe.send(None)
        self.process.join(5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(5)


def _family(pid: int) -> list[int]:
    """A process and those that it or they started."""
    found = [pid]
    for member in found:
        for path in Path(f"/proc/{member}/task").glob("*/children"):
            with contextlib.suppress(OSError):
                found += map(int, path.read_text().split())
    return found


def _computed_s(pid: int) -> float:
    """The processor time that a process has used, seconds."""
    with contextlib.suppress(OSError, IndexError, ValueError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS
    return 0.0


def _sleeps(pid: int) -> bool:
    """Whether no thread of a process is ready to compute."""
    states = []
    for path in Path(f"/proc/{pid}/task").glob("*/stat"):
        with contextlib.suppress(OSError, IndexError):
            states.append(path.read_text().rpartition(")")[2].split()[0])
    return "R" not in states


def _resident_bytes(pid: int) -> int:
    with contextlib.suppress(OSError, IndexError, ValueError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def _serve(pipe: Connection, part: str, seed: int, originals: Path, log: Path, most_bytes: int) -> None:
    """The child process: answers each number with (outcome, description, detail)."""
    stream = log.open("r+b", buffering=0)
    for descriptor in (1, 2):
        os.dup2(stream.fileno(), descriptor)
    faulthandler.enable(stream)
    for folder in (HERE.parents[1], HERE.parent, HERE.parent / "helpers"):
        if str(folder) not in sys.path:
            sys.path.insert(0, str(folder))
    module = importlib.import_module(f"fuzz.{part}")
    pipe.send("ready")
    while (number := pipe.recv()) is not None:
        stream.seek(0)
        stream.truncate()
        log.with_suffix(".note").write_text("", encoding="utf-8")
        if number < 0:
            pipe.send(_ended(lambda: module.prepare(originals), log, ""))
            continue
        folder = Path(tempfile.mkdtemp(prefix=f"{number}-", dir=originals.parent))
        os.chdir(folder)
        try:
            answer = _tried(module.attack, random.Random(f"{seed}/{part}/{number}"), originals, folder, log)
            if answer[0] in SOUND and (peak := _peak_bytes()) > most_bytes:
                answer = "memory", answer[1], f"{peak / 1e9:.1f} GB; {answer[2]}"
        finally:
            os.chdir(originals.parent)
            remove(folder)
        pipe.send(answer)


def _tried(
    attack: Callable[[random.Random, Path, Path], Attack], rng: random.Random, originals: Path, folder: Path, log: Path
) -> tuple[str, str, str]:
    try:
        made = attack(rng, originals, folder)
    except Exception:
        return "traceback", "(the mutator itself)", _last_lines(traceback.format_exc())
    description = " ".join(made.description.split())[:400]
    log.with_suffix(".note").write_text(description, encoding="utf-8", errors="backslashreplace")
    return _ended(made.run, log, description)


def _ended(run: Callable[[], object], log: Path, description: str) -> tuple[str, str, str]:
    from freeocc3d.core.errors import FreeOccError

    outcome, detail = "returned", ""
    try:
        run()
    except FreeOccError as error:
        outcome, detail = "refused", str(error)
    except Silent as error:
        outcome, detail = "silent", str(error)
    except SystemExit as error:
        sys.stdout.flush()
        detail = log.read_bytes()[-2000:].decode("utf-8", "replace").strip()
        known = error.code in (None, 0, 1, 2) and (not error.code or detail)
        outcome = ("refused" if error.code else "returned") if known else "traceback"
    except BaseException:
        outcome, detail = "traceback", _last_lines(traceback.format_exc())
    sys.stdout.flush()
    if outcome in SOUND and b"Traceback (most recent call last)" in log.read_bytes():
        outcome, detail = "traceback", log.read_bytes()[-2000:].decode("utf-8", "replace")
    return outcome, description, detail


def _peak_bytes() -> int:
    """The most memory that this process, or one of its own, has ever used; a process is replaced once it was too
    much. ``ru_maxrss`` of the process itself would count what its parent used before."""
    status = Path("/proc/self/status").read_text()
    own = int(status.partition("VmHWM:")[2].split()[0])
    return 1024 * max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)


def _last_lines(text: str, lines: int = 9) -> str:
    return "\n".join(line[:300] for line in text.strip().splitlines()[-lines:])


def remove(folder: Path) -> None:
    """Remove a folder with pipes, links and folders that cannot be entered."""
    for path, folders, _ in os.walk(folder):
        for name in ("", *folders):
            inner = os.path.join(path, name)
            if not os.path.islink(inner):
                os.chmod(inner, stat.S_IRWXU)
    shutil.rmtree(folder, ignore_errors=True)


def table(results: list[Result]) -> str:
    """The counts, part x outcome."""
    lines = [" ".join([f"{'part':12}", *(f"{name:>9}" for name in OUTCOMES), f"{'inputs':>9}", f"{'seconds':>9}"])]
    names = list(dict.fromkeys(result.part for result in results))
    for name in [*names, *(["all"] if len(names) > 1 else [])]:
        mine = [result for result in results if name in (result.part, "all")]
        counts = Counter(result.outcome for result in mine)
        seconds = sum(result.seconds for result in mine)
        numbers = (*(counts[outcome] for outcome in OUTCOMES), len(mine))
        lines.append(" ".join([f"{name:12}", *(f"{number:9}" for number in numbers), f"{seconds:9.0f}"]))
    return "\n".join(lines)


def failure(result: Result) -> str:
    """A failure with its number and the end of its traceback."""
    detail = "\n".join(f"    {line}" for line in result.detail.splitlines())
    return (
        f"{result.part} {result.number}: {result.outcome} after {result.seconds:.1f} s: {result.description}\n{detail}"
    )
