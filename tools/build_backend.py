"""Builds the package with setuptools. A wheel also gets the kernels of a first run, compiled ahead of time."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403 - the other hooks are those of setuptools

IMPORTED_BY_KERNELS = ["msgspec", "numba", "opencv-python-headless", "scipy"]


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    return [*build_meta.get_requires_for_build_wheel(config_settings), *IMPORTED_BY_KERNELS]


def build_wheel(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    if subprocess.run([sys.executable, "-m", "freeocc3d.core.ahead_of_time"]).returncode:
        print("The wheel lacks compiled kernels: the first run will compile what it lacks.", file=sys.stderr)
    return build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)
