"""Which tests are a module's own, and which modules hold machine code made from it."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path


class Project:
    """A package with tests that mirror it: package/room/part.py is tested by tests/room/test_part.py.

    A module's own tests are the test files of its room that bear its name, also after a folder's (encoders/clip.py:
    test_encoder_clip.py), and those of its room that import it. A module without any has the one of its folder
    (rasterizers/base.py: test_rasterizers.py) or, in turn, those of other rooms that import it; if there are none
    either, the own tests of the modules of its room that import it.
    """

    def __init__(self, root: Path, package: str) -> None:
        self.root, self.package = root, package
        folder = root / package
        self.modules = {
            path.relative_to(folder).with_suffix("").as_posix(): path
            for path in sorted(folder.rglob("*.py"))
            if path.name != "__init__.py"
        }
        """room/part -> file."""

    @cached_property
    def importers(self) -> dict[str, set[str]]:
        """The modules that import each module."""
        found = defaultdict(set)
        for module, path in self.modules.items():
            for imported in self._imports(path, [self.package, *module.split("/")[:-1]]):
                found[imported].add(module)
        return found

    @cached_property
    def _tests(self) -> dict[Path, set[str]]:
        """The modules that each test file imports."""
        return {path: self._imports(path, []) for path in sorted((self.root / "tests").rglob("test_*.py"))}

    @cached_property
    def foreign(self) -> set[str]:
        """Dotted names of all that the package imports from other packages, functions and classes included."""
        read = (found for path in self.modules.values() for found in _read_imports(path, [self.package]))
        return {name for source, names in read for name in (source, *(f"{source}.{name}" for name in names))}

    @cached_property
    def _handed_on(self) -> dict[str, str]:
        """Dotted name of what a folder's __init__.py imports -> dotted name of where it comes from."""
        found: dict[str, str] = {}
        for path in (self.root / self.package).rglob("__init__.py"):
            folder = list(path.parent.relative_to(self.root).parts)
            for source, names in _read_imports(path, folder):
                found |= {".".join([*folder, name]): f"{source}.{name}" for name in names}
        return found

    def _imports(self, path: Path, package: list[str]) -> set[str]:
        found = set()
        for source, names in _read_imports(path, package):
            full = [source, *(f"{source}.{name}" for name in names)]
            for name in full + [self._handed_on[name] for name in full if name in self._handed_on]:
                parts = name.split(".")
                if parts[0] == self.package:
                    found |= {"/".join(parts[1:]), "/".join(parts[1:-1])}
        return found & {*self.modules}

    def own_tests(self, module: str) -> list[Path]:
        """The test files that say what a module does, those with its name first."""
        room = module.split("/")[0]
        in_room = [path for path in self._tests if path.relative_to(self.root / "tests").parts[0] == room]
        mirrors = [path for path in in_room if path.stem in _test_names(module)]
        found = mirrors + [path for path in in_room if path not in mirrors and module in self._tests[path]]
        if found:
            return found
        if found := [path for path in in_room if path.stem in {f"test_{folder}" for folder in module.split("/")[1:-1]}]:
            return found
        if found := [path for path in self._tests if module in self._tests[path]]:
            return found
        users = [user for user in sorted(self.importers[module]) if user.startswith(room + "/")]
        return list(dict.fromkeys(path for user in users for path in self.own_tests(user)))

    def kernels_with(self, module: str) -> set[str]:
        """The modules whose compiled functions may hold code or constants of a module."""
        found, new = set(), {module}
        while new:
            found |= new
            new = {user for one in new for user in self.importers[one] if self.has_kernels(user)} - found
        return found

    def has_kernels(self, module: str) -> bool:
        """Whether Numba compiles functions of a module."""
        text = self.modules[module].read_text(encoding="utf-8")
        return "numba" in text or "njit" in text


def _test_names(module: str) -> set[str]:
    *folders, name = module.split("/")
    return {f"test_{name}", *(f"test_{folder}_{name}" for one in folders for folder in (one, one.removesuffix("s")))}


def _read_imports(path: Path, package: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Dotted name of each module that a file of a package imports, and the names that it takes from there."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            yield ".".join([*base, *filter(None, [node.module])]), [alias.name for alias in node.names]
