"""``models remove``: what has a model's name in the models folder, and nothing else."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import pytest
from command_line import refused, run

from freeocc3d.cli.main import main

REST = "rest"


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    home = tmp_path / "models"
    monkeypatch.setenv("FREEOCC3D_MODELS", str(home))
    for folder in ("one", "two", ".checkpoints/one", ".checkpoints/three", "four.partial"):
        (home / folder / "sub").mkdir(parents=True)
        (home / folder / "weights.onnx").write_bytes(bytes(1000))
        (home / folder / "sub" / "more").write_bytes(bytes(24))
    for name in ("one", "two"):
        (home / name / "manifest.yaml").write_text("damaged")
    (home / REST).mkdir()
    (home / REST / "letters.txt").write_text("mine")
    return home


def files(folder: Path) -> set[Path]:
    return set(folder.rglob("*"))


@pytest.mark.parametrize(
    ("name", "gone", "size"),
    [
        ("one", ["one", ".checkpoints/one"], 2055),
        ("two", ["two"], 1031),
        ("three", [".checkpoints/three"], 1024),
        ("four", ["four.partial"], 1024),
    ],
)
def test_a_model_is_removed_with_all_that_was_fetched_of_it(home: Path, name: str, gone: list[str], size: int) -> None:
    kept = {path for path in files(home.parent) if not any(path.is_relative_to(home / folder) for folder in gone)}
    said = json.loads(run("models", "remove", name, "--yes", "--json").stdout)
    assert said == {"removed": [str(home / folder) for folder in gone], "bytes": size}
    assert files(home.parent) == kept
    assert f"There is no model '{name}' in {home}" in refused("models", "remove", name, "--yes")


def test_it_says_what_is_freed(home: Path) -> None:
    assert run("models", "remove", "two", "--yes").stdout == f"removed {home / 'two'} (0.0 MB)\n"


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../models", "one/", "one/sub", "/", "/tmp", ".checkpoints", "~", REST, "nix"]
)
def test_what_is_no_model_is_refused_in_one_sentence(home: Path, name: str) -> None:
    before = files(home.parent)
    assert refused("models", "remove", name, "--yes")
    assert files(home.parent) == before


def test_a_link_is_removed_and_not_what_it_leads_to(home: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    (home / "two").rename(outside)
    (home / "two").symlink_to(outside)
    (home / "one" / "sub" / "link").symlink_to(outside)
    before = files(outside)
    for name in ("one", "two"):
        run("models", "remove", name, "--yes")
        assert not (home / name).exists()
    assert files(outside) == before


def test_without_a_terminal_it_wants_to_be_told(home: Path) -> None:
    before = files(home)
    assert refused("models", "remove", "one").endswith("add --yes if it shall.")
    assert files(home) == before


@pytest.mark.parametrize(("answer", "removed"), [("y\n", True), ("n\n", False), ("\n", False)])
def test_on_a_terminal_it_asks(home: Path, monkeypatch: pytest.MonkeyPatch, answer: str, removed: bool) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    asked = Terminal()
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    monkeypatch.setattr(sys, "stderr", asked)
    with pytest.raises(SystemExit) as end:
        main(["models", "remove", "two"])
    assert (end.value.code or 0) == (0 if removed else 1)
    assert f"Remove {home / 'two'} (0.0 MB)? [y/N]" in asked.getvalue()
    assert (home / "two").exists() == (not removed)
