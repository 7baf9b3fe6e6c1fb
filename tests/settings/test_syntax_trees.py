"""Modules are read without being imported."""

import pytest

from freeocc3d.settings import syntax_trees


def test_the_file_of_a_module() -> None:
    assert syntax_trees.path_of("freeocc3d.settings.stages") is not None
    assert syntax_trees.path_of("freeocc3d.export").name == "__init__.py"  # type: ignore[union-attr]
    assert syntax_trees.path_of("freeocc3d.export.nothing") is None
    assert syntax_trees.path_of("no_such_package_at_all.module") is None
    assert syntax_trees.path_of("textwrap") is not None
    assert syntax_trees.path_of("textwrap.inner") is None
    with pytest.raises(FileNotFoundError):
        syntax_trees.tree_of("freeocc3d.export.nothing")


def test_what_a_module_assigns() -> None:
    assert syntax_trees.summary_of("freeocc3d.settings.stages").startswith("The options of the stages")
    assert syntax_trees.assigned_value("freeocc3d.settings.registry", "FOLDERS") is not None
    assert syntax_trees.assigned_value("freeocc3d.settings.registry", "NOTHING") is None


def test_options_come_from_bases_in_other_files() -> None:
    found = {option.name: option for option in syntax_trees.options_of("freeocc3d.language.encoders.dinov2")}
    assert list(found)[:5] == ["model", "templates", "contrast", "threshold", "device"]
    assert found["short_side"].default == 448
    assert found["short_side"].doc == "Frames are resized to this many pixels on the shorter side."
    assert found["window"].type == "a whole number from 0 to 4096 or null"
    assert syntax_trees.options_of("freeocc3d.settings.registry") == ()
