"""Compiles the kernels of a first run ahead of time, on all processors: ``python -m freeocc3d.core.ahead_of_time``

The build of a wheel runs it (``tools/build_backend.py``), and ``make``. The kernels stand in ``first_kernels.txt``
(written by ``tools/list_kernels.py``), one a line: module, function, and a tuple of the types of its arguments as a
Python expression of Numba's types.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from numba.core.errors import NumbaError

from .portable_kernels import CPU_FEATURES, CPU_NAME, FOLDER, runs_here
from .threads import count_threads

LIST = Path(__file__).with_name("first_kernels.txt")


def compile_ahead() -> None:
    """Compile the listed kernels that are not compiled yet, and keep them in the package, if it can be written."""
    if not runs_here():
        raise SystemExit("This processor compiles kernels in the first run.")
    try:
        FOLDER.mkdir(exist_ok=True)
        tempfile.TemporaryFile(dir=FOLDER).close()
    except OSError as error:
        raise SystemExit(f"Kernels cannot be kept in {FOLDER}: {error.strerror}.") from None
    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {"NUMBA_CPU_NAME": CPU_NAME, "NUMBA_CPU_FEATURES": CPU_FEATURES, "NUMBA_CACHE_DIR": folder}
        lines = LIST.read_text(encoding="utf-8").splitlines()
        with ProcessPoolExecutor(count_threads(), multiprocessing.get_context("spawn"), _keep, (lines,)) as pool:
            failed = list(filter(None, pool.map(_compile, lines)))
    if failed:
        raise SystemExit("\n".join([*failed, f"Write {LIST} anew (tools/list_kernels.py)."]))


def _keep(lines: list[str]) -> None:
    """Keep every listed kernel in the package: compiling one compiles those that it calls."""
    from . import compiling

    for line in lines:
        with contextlib.suppress(ImportError, AttributeError, NameError, TypeError):  # which _compile reports
            kernel, _ = _read(line)
            kernel._cache = compiling.open_portable(kernel.py_func)


def _compile(line: str) -> str | None:
    """Compile a kernel; what is wrong with its line."""
    try:
        kernel, signature = _read(line)
        kernel.compile(signature)
    except (ImportError, AttributeError, NameError, TypeError, NumbaError) as error:
        return f"{' '.join(line.split()[:2])} cannot be compiled as listed: {str(error).splitlines()[0]}"
    return None


def _read(line: str) -> tuple[Any, Any]:
    """The compiled function of a line, and the types of its arguments."""
    from numba import types

    module_name, name, expression = line.split(" ", 2)
    module = importlib.import_module(module_name)
    return getattr(module, name), tuple(map(_type_of, eval(expression, vars(module) | vars(types))))


def _type_of(found: Any) -> Any:
    from numba import types

    if not isinstance(found, tuple):
        return found
    return types.BaseTuple.from_types(list(map(_type_of, found)), type(found) if hasattr(found, "_fields") else None)


def list_used() -> list[str]:
    """The lines of the kernels that this process has called and found compiled."""
    from numba.core.dispatcher import Dispatcher

    lines = set()
    for name, module in sys.modules.items():
        for kernel in vars(module).values() if name.startswith("freeocc3d.") else ():
            if isinstance(kernel, Dispatcher):
                function = kernel.py_func
                for signature in kernel.stats.cache_hits:
                    types = ", ".join(map(_write, signature))
                    lines.add(f"{function.__module__} {function.__qualname__} ({types},)")
    return sorted(lines)


def _write(found: Any) -> str:
    from numba import types

    if isinstance(found, types.BaseTuple):
        name = found.instance_class.__name__ if isinstance(found, types.BaseNamedTuple) else ""
        inner = ", ".join(map(_write, found.types))
        return f"{name}({inner})" if name else f"({inner},)"
    if isinstance(found, types.Array):
        return f"Array({found.dtype}, {found.ndim}, {found.layout!r}{'' if found.mutable else ', readonly=True'})"
    return str(found)


if __name__ == "__main__":
    compile_ahead()
