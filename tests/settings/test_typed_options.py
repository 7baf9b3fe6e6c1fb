"""Options classes: checked whoever makes them, frozen, with shared bases."""

from typing import Literal

import pytest

from freeocc3d.core.errors import ConfigError
from freeocc3d.settings.option_types import Finite, Positive, PositiveInt
from freeocc3d.settings.typed_options import TypedOptions, build, field_types, nearest


class Shared(TypedOptions, frozen=True):
    low: Finite = 0.0
    high: Finite = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.low >= self.high:
            raise ConfigError(f"'low' must be below 'high', got {self.low:g} and {self.high:g}.")


class Options(Shared, frozen=True):
    stride: PositiveInt = 4
    mode: Literal["a", "b"] = "a"
    high: Positive = 2.0


def test_options_are_inherited_and_may_be_overridden() -> None:
    assert list(field_types(Options)) == ["low", "high", "stride", "mode"]
    assert Options().high == 2.0
    assert Options().to_dict() == {"low": 0.0, "high": 2.0, "stride": 4, "mode": "a"}


def test_values_are_checked_where_options_are_made_directly() -> None:
    with pytest.raises(ConfigError, match=r"^'stride' must be at least 1, got 0\.$"):
        Options(stride=0)
    with pytest.raises(ConfigError, match=r"^'mode' must be a or b, got 'c'\.$"):
        Options(mode="c")  # type: ignore[arg-type]


def test_options_cannot_be_changed_in_place() -> None:
    with pytest.raises(AttributeError):
        Options().stride = 5  # type: ignore[misc]


def test_a_changed_copy_is_checked() -> None:
    assert Options().changed(stride=5) == Options(stride=5)
    with pytest.raises(ConfigError, match="'stride' must be at least 1"):
        Options().changed(stride=0)


def test_messages_name_the_section() -> None:
    with pytest.raises(ConfigError, match=r"'layer\.stride' must be at least 1, got 0"):
        build(Options, {"stride": 0}, "layer.")
    with pytest.raises(ConfigError, match=r"^'layer\.low' must be below 'layer\.high', got 3 and 2\.$"):
        build(Options, {"low": 3}, "layer.")
    with pytest.raises(ConfigError, match=r"Unknown key 'layer\.strid' \(did you mean 'stride'\?\)\."):
        build(Options, {"strid": 1}, "layer.")


def test_whole_numbers_become_floats() -> None:
    assert type(build(Options, {"high": 3}).high) is float


def test_the_nearest_word_is_named_if_it_is_near() -> None:
    assert nearest("strid", ["mode", "stride"]) == " (did you mean 'stride'?)"
    assert nearest("zzz", ["mode", "stride"]) == ""
    assert nearest(2, ["mode"]) == ""
