"""Imports flow one way, and what has to start fast imports nothing heavy. Read from the syntax trees: nothing runs."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "freeocc3d"

FLOORS = (
    ("errors", "types"),
    ("geometry", "hashing", "lattice", "registry", "progress", "files", "arrays", "onnx_model"),
    ("config", "keyframes", "manifest"),
    ("capture",),
    ("tracking",),
    ("gaussians",),
    ("language",),
    ("occupancy",),
    ("instances", "regions"),
    ("query",),
    ("patches", "places", "query_classes", "region_views", "relations", "standing"),
    ("store", "palette"),
    ("export", "viewer", "work", "details"),
    ("evaluation",),
    ("refine", "scale"),
    ("adaptive",),
    ("pipeline",),
    ("commands",),
    ("cli", "__init__"),
)
"""A part of the package imports from floors below its own only, and from itself."""

FLOOR = {part: floor for floor, parts in enumerate(FLOORS) for part in parts}
LAYERS = ("capture", "tracking", "gaussians", "language", "occupancy")

HEAVY = {"open3d", "torch", "pyvista", "vtk", "numba", "pycolmap", "scipy", "cv2", "onnxruntime"}
"""Packages whose import takes a good part of a second."""

FAST = (
    "store",
    "query",
    "regions",
    "instances",
    "places",
    "relations",
    "cli",
    "commands",
    "registry",
    "config",
    "__init__",
)
"""Modules that have to be imported in no time, for a query starts with them."""


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
    """The module within the package that an import names, None for other packages. The root package itself, of which
    only the version is taken, is "__init__"."""
    if imported.module == "freeocc3d":
        return "__init__"
    return imported.module.removeprefix("freeocc3d.") if imported.module.startswith("freeocc3d.") else None


def part_of(module: str) -> str:
    return module.split(".")[0]


def test_the_reader_of_imports_sees_all_kinds() -> None:
    source = (
        "import numpy as np\nfrom . import base\nfrom .. import registry, __version__\nfrom ..types import Frame\n"
        "if TYPE_CHECKING:\n    import torch\ndef f():\n    import open3d\n    from ..language.encoders import base\n"
    )
    found = list(_walk(ast.parse(source), ["freeocc3d", "capture"], lazy=False, typing_only=False))
    assert found == [
        Import("numpy", None, False, False),
        Import("freeocc3d.capture.base", None, False, False),
        Import("freeocc3d.registry", None, False, False),
        Import("freeocc3d", "__version__", False, False),
        Import("freeocc3d.types", "Frame", False, False),
        Import("torch", None, False, True),
        Import("open3d", None, True, False),
        Import("freeocc3d.language.encoders.base", None, True, False),
    ]


def test_every_part_has_its_floor() -> None:
    assert {part_of(module) for module in MODULES} <= set(FLOOR), "a new part needs a place in FLOORS"


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_downwards(module: str) -> None:
    here = part_of(module)
    for imported in imports_of(module):
        target = own(imported)
        if target is None or imported.typing_only or part_of(target) == here:
            continue
        if target == "__init__" and imported.name == "__version__":
            continue
        assert FLOOR[part_of(target)] < FLOOR[here], f"{module} imports {target}, which does not stand below it"


@pytest.mark.parametrize("module", MODULES)
def test_only_public_names_cross_between_parts(module: str) -> None:
    for imported in imports_of(module):
        target = own(imported)
        if target is not None and part_of(target) != part_of(module):
            names = [*target.removeprefix("__init__").split("."), imported.name or ""]
            private = [name for name in names if name.startswith("_") and name != "__version__"]
            assert not private, f"{module} imports the private {private} of {target}"


@pytest.mark.parametrize(
    ("target", "allowed"),
    [
        ("pipeline", {"cli", "__init__"}),
        ("cli", set()),
        ("config", {"pipeline", "refine", "scale", "adaptive", "cli", "commands", "work", "evaluation", "patches"}),
        (
            "store",
            {
                "pipeline",
                "refine",
                "scale",
                "adaptive",
                "cli",
                "commands",
                "work",
                "__init__",
                "export",
                "evaluation",
                "viewer",
                "details",
            },
        ),
    ],
)
def test_who_may_import(target: str, allowed: set[str]) -> None:
    users = {
        part_of(module)
        for module in MODULES
        for imported in imports_of(module)
        if part_of(own(imported) or "") == target and part_of(module) != target and not imported.typing_only
    }
    assert users <= allowed


@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_knows_no_configuration_and_no_map(layer: str) -> None:
    above = {part for part, floor in FLOOR.items() if floor > FLOOR["occupancy"]} | {"config"}
    for module in (name for name in MODULES if part_of(name) == layer):
        used = {part_of(own(imported) or "") for imported in imports_of(module)}
        assert not used & above, f"{module} imports {used & above}"


def test_number_crunching_does_not_import_open3d() -> None:
    crunching = [
        module
        for module in MODULES
        if part_of(module) in ("gaussians", "occupancy") or module in ("language.lift", "language.codec")
    ]
    assert "gaussians.anchors" in crunching
    assert "occupancy.splat" in crunching
    for module in crunching:
        if module not in ("gaussians.cloud", "occupancy.voxel_block_grid"):  # the containers, which are Open3D's
            packages = {part_of(imported.module) for imported in imports_of(module)}
            assert "open3d" not in packages, f"{module} imports open3d"


@pytest.mark.parametrize("module", [name for name in FAST if name in MODULES])
def test_what_starts_fast_imports_nothing_heavy(module: str) -> None:
    trail = {module: module}
    waiting = [module]
    while waiting:
        present = waiting.pop()
        for imported in imports_of(present):
            if imported.lazy or imported.typing_only:
                continue
            package = part_of(imported.module)
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
    packages = {part_of(imported.module) for imported in imports_of("registry")} - {"freeocc3d"}
    assert not packages & (HEAVY | {"numpy", "yaml"})
