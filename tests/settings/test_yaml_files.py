"""YAML in: numbers without a point, overrides, assignments."""

from pathlib import Path

import pytest

from freeocc3d.core.errors import ConfigError
from freeocc3d.settings.option_types import Finite
from freeocc3d.settings.yaml_files import apply_override, named_values, parse_yaml, read_yaml


@pytest.mark.parametrize(("text", "value"), [("1e-4", 1e-4), ("-2E3", -2e3), ("1.5e-3", 1.5e-3), ("12", 12)])
def test_numbers(text: str, value: float) -> None:
    assert parse_yaml(text) == value
    assert type(parse_yaml(text)) is type(value)


def test_words_stay_words() -> None:
    assert parse_yaml("e4") == "e4"
    assert parse_yaml("1e4x") == "1e4x"
    assert parse_yaml("'1e4'") == "1e4"


def test_a_file_of_nothing_holds_no_section(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("# nothing\n")
    assert read_yaml(tmp_path / "c.yaml") == {}


def test_an_override_goes_into_what_is_there() -> None:
    values = {"a": {"x": 1}, "b": None}
    apply_override(values, "a.y=[1, 2]")
    apply_override(values, "b.c.d=1e-3")
    assert values == {"a": {"x": 1, "y": [1, 2]}, "b": {"c": {"d": 1e-3}}}


def test_lists_may_go_without_brackets() -> None:
    kinds = {"words": tuple[str, ...], "box": tuple[Finite, Finite] | None, "name": str}
    found = named_values(["words=red cup, 7", "box=1,2e-1", "name=a, b"], kinds)
    assert found == {"words": ["red cup", "7"], "box": [1, 0.2], "name": "a, b"}
    assert named_values(["box=null", "words=[a]"], kinds) == {"box": None, "words": ["a"]}


def test_what_is_no_assignment_is_refused() -> None:
    with pytest.raises(ConfigError, match="An option has the form name=value, got 'words'"):
        named_values(["words"], {})
    with pytest.raises(ConfigError, match=r"The value of 'x' is not valid YAML: '\['"):
        named_values(["x=["], {})
