"""Pages are short, name existing files, and use the package's names in their Python code."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LONGEST_PAGE, LONGEST_README = 1500, 900  # words


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_a_page_is_short(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert len(text.split()) <= (LONGEST_README if page.name == "README.md" else LONGEST_PAGE)


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_named_files_exist(page: Path) -> None:
    said = re.findall(r"`((?:freeocc3d|configs|tools|tests|notebooks)/[\w/.-]*)`", page.read_text(encoding="utf-8"))
    assert not [path for path in said if not (ROOT / path).exists()]


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=named)
def test_links_of_the_top_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\((?!http)([^)#]+)", page.read_text(encoding="utf-8"))
    assert not [link for link in links if not (ROOT / link).exists()]


JSON = ["cli/map_summary", "cli/check", "cli/query_answers", "cli/region_details", "cli/scores", "cli/objects"]


@pytest.mark.parametrize("module", [*JSON, "query/objects/description"])
def test_every_key_of_json_is_explained(module: str) -> None:
    """Keys of the dictionaries in functions whose names end in document, or that details are made by."""
    page = (ROOT / "docs" / "reference" / "json.md").read_text(encoding="utf-8")
    tree = ast.parse((ROOT / "freeocc3d" / f"{module}.py").read_text(encoding="utf-8"))
    keys = {
        key.value
        for function in tree.body
        if isinstance(function, ast.FunctionDef) and not function.name.endswith("text")
        for node in ast.walk(function)
        if isinstance(node, ast.Dict)
        for key in node.keys
        if isinstance(key, ast.Constant)
    }
    assert not [key for key in keys if f"{key}`" not in page and f'"{key}"' not in page]


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_python_names_what_there_is(page: Path) -> None:
    """Imports from the package, and attributes of imported names."""
    for block in re.findall(r"```python[^\n]*\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        imported = {}
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("freeocc3d"):
                pytest.importorskip(node.module or "")
                for alias in node.names:
                    imported[alias.name] = taken(node.module or "", alias.name)
            elif isinstance(node, ast.Import):
                imported |= {a.name: importlib.import_module(a.name) for a in node.names if a.name == "freeocc3d"}
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in imported:
                assert hasattr(imported[node.value.id], node.attr), f"{node.value.id}.{node.attr}"


def taken(module: str, name: str) -> object:
    """The object that ``from module import name`` gives."""
    loaded = importlib.import_module(module)
    return getattr(loaded, name) if hasattr(loaded, name) else importlib.import_module(f"{module}.{name}")
