"""Compiles kernels with Numba, and keeps them in folders that may be used, or nowhere.

Numba itself keeps no code of an installation that is read-only, raises an error where there is no home, and takes a
kernel for fresh if another file changed that it calls or whose constants it uses.

Kernels have no ``fastmath``: it lets the compiler sum in any order. A function would then give one result where it is
compiled, and another one where it comes from the cache within a function that calls it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache

from .kernel_folders import find_writable_folder
from .portable_kernels import FOLDER, PortableCache, runs_here

_stamps: dict[Any, str] = {}
"""What the code of each compiled function depends on, hashed."""


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` with options, whose ``cache=True`` works in every installation."""
    cache = options.pop("cache", False)

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if cache and isinstance(dispatcher, numba.core.dispatcher.Dispatcher):  # not with NUMBA_DISABLE_JIT
            dispatcher._cache = _Cache(function)
        return dispatcher

    return compiled


class _Cache:
    """Numba's interface of caches. Reads from the folder that can be written. What that lacks it reads from the kernels
    that were compiled ahead of time, then from the installation, which may hold the kernels of a container's image,
    unless the user chose a folder. A damaged or missing file, or a full disk, is never an error."""

    def __init__(self, function: Callable[..., Any]):
        source = Path(function.__code__.co_filename).parent
        stamp = _stamps[function] = _hash_dependencies(function)
        self._own = find_writable_folder(source)
        chosen = self._own is not None and "NUMBA_CACHE_DIR" in os.environ
        folders = dict.fromkeys((self._own, None if chosen else source / "__pycache__"))
        self._caches = [_open_folder(function, folder, stamp) for folder in folders if folder is not None]
        if runs_here():
            self._caches.insert(self._own is not None, open_portable(function))

    @property
    def cache_path(self) -> str | None:
        return None if self._own is None else str(self._own)

    def load_overload(self, signature: Any, context: Any) -> Any:
        for cache in self._caches:
            with contextlib.suppress(Exception):  # a damaged pickle raises anything
                found = cache.load_overload(signature, context)
                if found is not None:
                    return found
        return None

    def save_overload(self, signature: Any, data: Any) -> None:
        if self._own is None:
            return
        with contextlib.suppress(OSError):
            try:
                self._caches[0].save_overload(signature, data)
            except Exception:  # a damaged index
                self._caches[0].flush()
                self._caches[0].save_overload(signature, data)

    def enable(self) -> None:
        for cache in self._caches:
            cache.enable()

    def disable(self) -> None:
        for cache in self._caches:
            cache.disable()

    def flush(self) -> None:
        if self._own is not None:
            self._caches[0].flush()


class _Locator:
    """Numba's interface of the place of a function's files."""

    def __init__(self, function: Callable[..., Any], folder: Path, stamp: str):
        self._line, self._folder, self._stamp = function.__code__.co_firstlineno, folder, stamp

    def from_function(self, function: Callable[..., Any], file: str) -> _Locator:
        return self

    def ensure_cache_path(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return str(self._line)


def open_portable(function: Callable[..., Any]) -> PortableCache:
    """The files of a function that is compiled ahead of time (``ahead_of_time``)."""
    return _open_folder(function, FOLDER / function.__module__, _stamps[function], PortableCache)


def _open_folder(function: Callable[..., Any], folder: Path, stamp: str, kind: type = FunctionCache) -> Any:
    locators = [_Locator(function, folder, stamp)]
    implementation = type("Files", (CompileResultCacheImpl,), {"_locator_classes": locators})
    return type("Folder", (kind,), {"_impl_class": implementation})(function)


def _hash_dependencies(function: Callable[..., Any]) -> str:
    """The source, and what it imported: numbers, which become constants, and compiled functions, which may become part
    of this one."""
    found = [_hash_source(function.__code__.co_filename)]
    for name, value in sorted(function.__globals__.items()):
        if isinstance(value, bool | int | float | tuple) and not name.startswith("__"):
            found.append(f"{name}={value!r}")
        elif (other := getattr(value, "py_func", None)) is not None:
            found.append(f"{name}={_stamps.get(other)}")
    return hashlib.blake2b("\n".join(found).encode(), digest_size=16).hexdigest()


@functools.cache
def _hash_source(file: str) -> str:
    return hashlib.blake2b(Path(file).read_bytes(), digest_size=16).hexdigest()
