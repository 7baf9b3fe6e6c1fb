#!/usr/bin/env python3
"""Builds the wheel, installs it into an empty environment, and runs its demo there: python tools/check_wheel.py

A path in the site-packages of the new environment points to the dependencies of this interpreter's environment, so
nothing is downloaded. freeocc3d itself can only come from the wheel: the new processes start outside the repository.
The demo has neither a home nor kernels but those of the wheel, and must compile nothing.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import venv
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
SOURCES = ("freeocc3d", "configs", "setup.cfg", "pyproject.toml", "tools/build_backend.py", "README.md", "LICENSE")
FRAMES = 12
PICTURES = ("map.png", "query_red_cup.png", "query_blue_chair.png", "query_something_to_sit_on.png")


def build_wheel(folder: Path) -> Path:
    """The wheel, built from a copy of the sources without earlier builds."""
    sources = folder / "sources"
    sources.mkdir()
    for name in SOURCES:
        path = REPOSITORY / name
        (sources / name).parent.mkdir(exist_ok=True)
        if path.is_dir():
            shutil.copytree(
                path, sources / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", "compiled")
            )
        else:
            shutil.copy(path, sources / name)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(folder), str(sources)], folder)
    return next(folder.glob("*.whl"))


def install(wheel: Path, folder: Path) -> Path:
    """The folder of programs of a new environment that holds the wheel and finds the dependencies of this one."""
    venv.create(folder, with_pip=False)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--python", str(python)]
    run([*pip, "install", "--no-deps", "--no-index", str(wheel)], folder)
    packages = run([str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], folder)
    paths = dict.fromkeys((sysconfig.get_path("purelib"), sysconfig.get_path("platlib")))
    (Path(packages.strip()) / "dependencies.pth").write_text("\n".join(paths) + "\n", encoding="utf-8")
    return python.parent


def run(command: list[str], folder: Path, **added: str) -> str:
    """The stdout of a command that starts in a folder outside the repository, with added variables."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")} | added
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    return done.stdout


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="freeocc3d-wheel-") as temporary:
        folder = Path(temporary)
        wheel = build_wheel(folder)
        programs = install(wheel, folder / "environment")
        found = run([str(programs / "python"), "-c", "import freeocc3d; print(freeocc3d.__file__)"], folder).strip()
        if not Path(found).is_relative_to(folder / "environment"):
            raise SystemExit(f"freeocc3d comes from {found}, not from the wheel")
        command = str(programs / "freeocc3d")
        run([command, "list"], folder)
        variables = {"HOME": "/nonexistent", "NUMBA_CACHE_DIR": str(folder / "kernels")}
        print(run([command, "demo", "--frames", str(FRAMES), "-o", "demo"], folder, **variables))
        if compiled := [path.name for path in folder.glob("kernels/*/*.nbc")]:
            raise SystemExit(f"the first run compiled {', '.join(compiled)}")
        if missing := [name for name in PICTURES if not (folder / "demo" / name).is_file()]:
            raise SystemExit(f"the demo left out {', '.join(missing)}")
        print(f"{wheel.name}: {wheel.stat().st_size:,} bytes, installed, and its demo ran")


if __name__ == "__main__":
    main()
