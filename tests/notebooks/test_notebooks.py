"""Every notebook runs from top to bottom, on a small map that the first one makes."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted(Path(__file__).parents[2].joinpath("notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all of them run, so that they share the map."""
    return tmp_path_factory.mktemp("notebooks")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path: Path, folder: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert all(
        cell.get("execution_count") is None for cell in nbformat.read(path, as_version=4).cells if "outputs" in cell
    )


def test_there_is_a_notebook_for_each_layer_for_words_and_for_planners() -> None:
    names = [path.stem for path in NOTEBOOKS]
    assert [name[:7] for name in names if name.startswith("layer_")] == ["layer_1", "layer_2", "layer_3", "layer_4"]
    assert {"words", "planners"} < set(names)
