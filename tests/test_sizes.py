"""Files and functions are short, according to their syntax trees."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "freeocc3d"

LONGEST_FILE, LONGEST_FUNCTION, LONGEST_KERNEL = 400, 80, 120
"""Lines. A kernel is a function that Numba compiles."""

SHORT, SHARE_OF_SHORT = 32, 0.95
"""Lines that this share of all functions does not exceed."""

FILES = {str(path.relative_to(ROOT)): path for path in sorted(ROOT.rglob("*.py"))}


def functions(source: str) -> list[tuple[str, int, bool]]:
    """Name, lines and whether Numba compiles it, of every function of a module, methods and inner ones too."""
    return [
        (
            node.name,
            (node.end_lineno or 0) - node.lineno + 1,
            any("jit" in ast.unparse(decorator) for decorator in node.decorator_list),
        )
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]


def test_the_reader_of_functions_sees_kernels_and_inner_functions() -> None:
    source = "@njit(cache=True)\ndef f(a):\n    return a\n\ndef g():\n    def h():\n        pass\n\n    return h\n"
    assert functions(source) == [("f", 2, True), ("g", 5, False), ("h", 2, False)]


@pytest.mark.parametrize("name", FILES)
def test_a_file_and_its_functions_are_short(name: str) -> None:
    source = FILES[name].read_text(encoding="utf-8")
    lines = len(source.splitlines())
    assert lines <= LONGEST_FILE, f"{name} has {lines} lines"
    for function, length, kernel in functions(source):
        assert length <= (LONGEST_KERNEL if kernel else LONGEST_FUNCTION), f"{name}: {function} has {length} lines"


def test_most_functions_are_very_short() -> None:
    lengths = [length for path in FILES.values() for _, length, _ in functions(path.read_text(encoding="utf-8"))]
    assert sum(length <= SHORT for length in lengths) >= SHARE_OF_SHORT * len(lengths)
