"""Imports flow one way, also within rooms, and what must start fast imports nothing heavy. Reads the syntax trees
only."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "freeocc3d"

ROOMS = (
    "core",
    "settings",
    "capture",
    "tracking",
    "depth",
    "gaussians",
    "language",
    "occupancy",
    "storage",
    "query",
    "viewer",
    "export",
    "editing",
    "evaluation",
    "pipeline",
    "cli",
)
"""A room imports from the rooms before it, and from itself."""

MOST_LOOSE = 3

HEAVY = {"open3d", "torch", "pyvista", "vtk", "numba", "pycolmap", "scipy", "cv2", "onnxruntime"}
"""Packages whose import takes a good part of a second."""

FAST = (
    *("storage", "query", "cli", "settings", "core.types", "core.progress", "core.errors", "__init__"),
    *("language.encoders.color", "language.encoders.labels"),
)
"""Rooms and modules that have to be imported in no time, for a query starts with them."""

SLOW = {
    *("storage.keyframes", "storage.work_folder", "storage.writer", "query.best_views", "query.standing_places"),
    *("query.objects.agglomeration", "query.objects.structure", "query.objects.surface_instances"),
    *("query.objects.surfels", "query.objects.view_features"),
}
"""Modules of fast rooms that a query does not start with."""


@dataclass(frozen=True)
class Import:
    """One imported module. lazy: inside a function.  typing_only: below ``if TYPE_CHECKING``.  name: what is taken from
    the module, None for a whole module."""

    module: str
    name: str | None
    lazy: bool
    typing_only: bool


def modules() -> dict[str, Path]:
    """Dotted name within the package -> file; a folder's name stands for its __init__, "__init__" for the root's."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)] = path
    return found


MODULES = modules()


def imports_of(module: str) -> list[Import]:
    path = MODULES[module]
    package = ["freeocc3d", *path.relative_to(ROOT).parent.parts]
    return list(_walk(ast.parse(path.read_text(encoding="utf-8")), package, lazy=False, typing_only=False))


def _walk(node: ast.AST, package: list[str], lazy: bool, typing_only: bool) -> Iterator[Import]:
    if isinstance(node, ast.Import):
        for alias in node.names:
            yield Import(alias.name, None, lazy, typing_only)
    elif isinstance(node, ast.ImportFrom):
        base = package[: len(package) - node.level + 1] if node.level else []
        target = ".".join([*base, *([node.module] if node.module else [])])
        for alias in node.names:
            inner = f"{target}.{alias.name}".removeprefix("freeocc3d.")
            whole = target.split(".")[0] == "freeocc3d" and inner in MODULES
            yield Import(
                f"{target}.{alias.name}" if whole else target, None if whole else alias.name, lazy, typing_only
            )
    elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        for child in node.body:
            yield from _walk(child, package, lazy, typing_only=True)
        for child in node.orelse:
            yield from _walk(child, package, lazy, typing_only)
    else:
        lazy = lazy or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for child in ast.iter_child_nodes(node):
            yield from _walk(child, package, lazy, typing_only)


def own(imported: Import) -> str | None:
    """The module within the package that an import names; None for other packages. The root package itself is
    "__init__"; only its version is imported."""
    if imported.module == "freeocc3d":
        return "__init__"
    return imported.module.removeprefix("freeocc3d.") if imported.module.startswith("freeocc3d.") else None


def room_of(module: str) -> str:
    return module.split(".")[0]


def test_the_reader_of_imports_sees_all_kinds() -> None:
    source = (
        "import numpy as np\nfrom . import base\nfrom ..settings import registry\nfrom .. import __version__\n"
        "from ..core.types import Frame\nif TYPE_CHECKING:\n    import torch\ndef f():\n    import open3d\n"
        "    from ..language.encoders import base\n"
    )
    found = list(_walk(ast.parse(source), ["freeocc3d", "capture"], lazy=False, typing_only=False))
    assert found == [
        Import("numpy", None, False, False),
        Import("freeocc3d.capture.base", None, False, False),
        Import("freeocc3d.settings.registry", None, False, False),
        Import("freeocc3d", "__version__", False, False),
        Import("freeocc3d.core.types", "Frame", False, False),
        Import("torch", None, False, True),
        Import("open3d", None, True, False),
        Import("freeocc3d.language.encoders.base", None, True, False),
    ]


def test_every_module_has_its_room() -> None:
    loose = {module for module, path in MODULES.items() if path.parent == ROOT}
    assert len(loose) <= MOST_LOOSE
    assert {room_of(module) for module in MODULES if module not in loose} == set(ROOMS)


def test_the_package_names_its_rooms_in_the_order_of_imports() -> None:
    listed = ast.get_docstring(ast.parse((ROOT / "__init__.py").read_text(encoding="utf-8"))) or ""
    rooms = [line.split()[0] for line in listed.splitlines() if line.startswith("    ") and line.split()[0] in ROOMS]
    assert tuple(rooms) == ROOMS


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_to_earlier_rooms(module: str) -> None:
    here = room_of(module)
    for imported in imports_of(module):
        target = own(imported)
        if target is None or imported.typing_only or room_of(target) == here:
            continue
        if target == "__init__" and imported.name == "__version__":
            continue
        assert here in ("__init__", "__main__") or (
            target != "__init__" and ROOMS.index(room_of(target)) < ROOMS.index(here)
        ), f"{module} imports {target}, which is in no earlier room"


def test_no_circle_at_any_level() -> None:
    """Of files, whatever the room; a folder's __init__ counts as a file that imports what it names."""
    reached: dict[str, set[str]] = {
        module: {own(i) or "" for i in imports_of(module) if not i.typing_only} & set(MODULES) - {"__init__"}
        for module in MODULES
    }
    circles = []
    done: set[str] = set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        if module in trail:
            circles.append(" -> ".join((*trail[trail.index(module) :], module)))
        elif module not in done:
            for target in sorted(reached[module]):
                visit(target, (*trail, module))
            done.add(module)

    for module in MODULES:
        visit(module, ())
    assert not circles


@pytest.mark.parametrize("module", MODULES)
def test_only_public_names_cross_between_rooms(module: str) -> None:
    for imported in imports_of(module):
        target = own(imported)
        if target is not None and room_of(target) != room_of(module):
            names = [*target.removeprefix("__init__").split("."), imported.name or ""]
            private = [name for name in names if name.startswith("_") and name != "__version__"]
            assert not private, f"{module} imports the private {private} of {target}"


@pytest.mark.parametrize(("target", "allowed"), [("pipeline", {"cli", "__init__"}), ("cli", {"__main__"})])
def test_who_may_import(target: str, allowed: set[str]) -> None:
    users = {
        room_of(module)
        for module in MODULES
        for imported in imports_of(module)
        if room_of(own(imported) or "") == target and room_of(module) != target and not imported.typing_only
    }
    assert users <= allowed


def test_number_crunching_does_not_import_open3d() -> None:
    crunching = [
        module
        for module in MODULES
        if room_of(module) in ("depth", "gaussians", "occupancy") or module in ("language.lifting",)
    ]
    assert "gaussians.anchors" in crunching
    assert "occupancy.splat" in crunching
    for module in crunching:
        if module not in ("gaussians.point_cloud", "depth.watertight_surface"):
            packages = {room_of(imported.module) for imported in imports_of(module)}
            assert "open3d" not in packages, f"{module} imports open3d"


@pytest.mark.parametrize("module", [name for name in MODULES if name in FAST or room_of(name) in FAST])
def test_what_starts_fast_imports_nothing_heavy(module: str) -> None:
    if module in SLOW:
        pytest.skip("a query does not start with it")
    trail = {module: module}
    waiting = [module]
    while waiting:
        present = waiting.pop()
        for imported in imports_of(present):
            if imported.lazy or imported.typing_only:
                continue
            package = room_of(imported.module)
            assert package not in HEAVY, f"{trail[present]} imports {package} when it is imported"
            for name in _with_parents(own(imported)):
                if name not in trail:
                    trail[name] = f"{trail[present]} -> {name}"
                    waiting.append(name)


def _with_parents(module: str | None) -> list[str]:
    """A module and the folders around it, whose __init__ is imported before it."""
    if module is None:
        return []
    parts = module.split(".")
    return [name for end in range(1, len(parts) + 1) if (name := ".".join(parts[:end])) in MODULES]


def test_the_list_of_backends_needs_only_the_standard_library() -> None:
    packages = {room_of(imported.module) for imported in imports_of("settings.registry")} - {"freeocc3d"}
    assert not packages & (HEAVY | {"numpy", "yaml"})


def test_a_reconstruction_imports_no_evaluation() -> None:
    waiting, reached = ["pipeline.run"], {"pipeline.run"}
    while waiting:
        for imported in imports_of(waiting.pop()):
            if not imported.typing_only:
                new = set(_with_parents(own(imported))) - reached
                reached |= new
                waiting += new
    assert not {module for module in reached if room_of(module) == "evaluation"}
