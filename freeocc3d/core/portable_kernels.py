"""Files of kernels that are compiled for a level of processors rather than for one: a wheel carries them.

The level is x86-64-v3, of all desktop and server processors since 2013 (Intel) and 2015 (AMD). Others compile what they
call.

Source: System V Application Binary Interface, AMD64 Architecture Processor Supplement, section 3.1.1.
"""

from __future__ import annotations

import functools
import os
import platform
from pathlib import Path
from typing import Any

from llvmlite import binding
from numba.core.caching import FunctionCache

FOLDER = Path(__file__).with_name("compiled")

CPU_NAME = "x86-64-v3"
"""LLVM's name of the level."""

CPU_FEATURES = "+avx2,+bmi,+bmi2,+f16c,+fma,+lzcnt,+movbe"
"""What it has besides earlier levels, for LLVM."""


class PortableCache(FunctionCache):
    """Numba's files of a function, but its code is for any processor of the level."""

    def _index_key(self, signature: Any, codegen: Any) -> tuple[Any, ...]:
        key = super()._index_key(signature, codegen)
        return key[0], CPU_NAME, key[2]


@functools.cache
def runs_here() -> bool:
    """Whether this processor is of the level, and no other was asked for."""
    if platform.machine() != "x86_64" or "NUMBA_CPU_NAME" in os.environ:
        return False
    found = binding.get_host_cpu_features()
    return all(found.get(name[1:], False) for name in CPU_FEATURES.split(","))
