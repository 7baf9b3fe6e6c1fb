"""Types with ranges: which values are valid, and the messages about the others."""

import ast
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from msgspec import Meta

from freeocc3d.core.errors import ConfigError
from freeocc3d.settings.option_types import (
    Advanced,
    Cosine,
    Device,
    FilePath,
    Finite,
    Meters,
    NotNegative,
    NotNegativeInt,
    Positive,
    PositiveInt,
    PositiveShare,
    Seed,
    Share,
    annotated_type,
    converted,
    described,
    holds_text,
    is_advanced,
    is_list,
)


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        (int, 3, 3),
        (Finite, 2, 2.0),
        (bool, False, False),
        (str, "7", "7"),
        (int | None, None, None),
        (Positive | None, 1, 1.0),
        (tuple[Finite, Finite], [1, 2.5], (1.0, 2.5)),
        (tuple[str, ...], [], ()),
        (Literal["a", "b"], "b", "b"),
        (Advanced[Positive], 2, 2.0),
        (Positive, np.float64(0.5), 0.5),
        (Positive, np.float32(0.5), 0.5),
        (PositiveInt, np.int64(5), 5),
        (tuple[Positive, Positive], (np.float64(1), 2), (1.0, 2.0)),
    ],
)
def test_values_that_fit(kind: Any, value: object, expected: object) -> None:
    found = converted(kind, value, "layer.x")
    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        (int, 3.0, "a whole number, got 3.0"),
        (int, True, "a whole number, got true"),
        (int, "3", "a whole number, got '3'"),
        (int, None, "a whole number, got null"),
        (Finite, True, "a number, got true"),
        (Finite, float("nan"), "a finite number, got nan"),
        (Positive | None, float("inf"), "a finite number, got inf"),
        (Share, float("nan"), "a finite number, got nan"),
        (bool, 1, "true or false, got 1"),
        (str, 7, "text, got 7"),
        (Positive, -1, "greater than 0, got -1"),
        (Positive, "8 cm", "a number greater than 0, got '8 cm'"),
        (Positive | None, 0, "greater than 0, got 0"),
        (Positive | None, "x", "a number greater than 0 or null, got 'x'"),
        (NotNegative, -0.5, "at least 0, got -0.5"),
        (PositiveInt, 0, "at least 1, got 0"),
        (PositiveInt, 1.5, "a whole number of at least 1, got 1.5"),
        (NotNegativeInt, -1, "at least 0, got -1"),
        (Share, 1.5, "from 0 to 1, got 1.5"),
        (PositiveShare, 0, "greater than 0 and at most 1, got 0"),
        (Cosine, -2, "from -1 to 1, got -2"),
        (Annotated[float, Meta(gt=0, lt=1)], 1, "greater than 0 and less than 1, got 1"),
        (Advanced[Positive | None], -1, "greater than 0, got -1"),
        (Positive, 1e300, "from 1e-09 to 1e+09, got 1e+300"),
        (Positive, 1e-300, "at least 1e-09, got 1e-300"),
        (NotNegative | None, 10**400, "from 0 to 1e+09, got about 1e400"),
        pytest.param(Finite, -(10**5000), "from -1e+09 to 1e+09, got about -1e5000", id="long"),
        (NotNegativeInt, 2**63, "from 0 to 1e+09, got 9223372036854775808"),
        (Seed, -1, "from 0 to 4294967295, got -1"),
        (Meters, 2000, "from 0.0001 to 1000, got 2000"),
        (tuple[Finite, Finite], [1, 1e12], "a list of 2 numbers from -1e+09 to 1e+09, got [1, 1000000000000.0]"),
        (Device, "", "a device such as cpu or cuda:0, got ''"),
        (Device, "cuda:0 ", "a device such as cpu or cuda:0, got 'cuda:0 '"),
        (FilePath | None, "", "a path or null, got ''"),
        (str, "a\0b", "text of at most 4096 characters in UTF-8, without NUL, got 'a\\x00b'"),
        (FilePath, "a\ud800", "text of at most 4096 characters in UTF-8, without NUL, got 'a\\ud800'"),
        (Finite, [[[[[1]]]]], "a number, got [[[[...]]]]"),
        (Literal["a", "b", "c"], "d", "a, b or c, got 'd'"),
        (Literal["a", "b"] | None, 1, "a, b or null, got 1"),
        (tuple[Finite, Finite], [1.0], "a list of 2 numbers, got [1.0]"),
        (tuple[Positive, Positive], [1.0, 0], "a list of 2 numbers greater than 0, got [1.0, 0]"),
        (tuple[int, ...], [1, "2"], "a list of whole numbers, got [1, '2']"),
        (tuple[str, ...], "abc", "a list of text values, got 'abc'"),
    ],
)
def test_values_that_do_not_fit_are_refused_with_their_place(kind: Any, value: object, expected: str) -> None:
    with pytest.raises(ConfigError) as error:
        converted(kind, value, "layer.x")
    assert str(error.value) == f"'layer.x' must be {expected}."


def test_a_type_is_described_for_a_list_of_options() -> None:
    assert described(Positive | None) == "a number greater than 0 or null"
    assert described(Advanced[Literal["a", "b"]]) == "a or b"
    assert described(tuple[PositiveInt, PositiveInt]) == "a list of 2 whole numbers of at least 1"
    assert described("Something | None") == "Something | None"


def test_advanced_is_seen_through_unions() -> None:
    assert is_advanced(Advanced[Positive | None])
    assert is_advanced(Advanced[bool])
    assert not is_advanced(Positive | None)
    assert not is_advanced("Unknown")


def test_what_lists_hold() -> None:
    assert is_list(tuple[str, ...] | None)
    assert holds_text(tuple[str, ...] | None)
    assert is_list(Advanced[tuple[int, int]])
    assert not holds_text(tuple[Finite, Finite])
    assert not is_list(str)


def test_an_annotation_in_a_syntax_tree_is_the_type() -> None:
    def read(text: str, **aliases: str) -> Any:
        trees = {name: ast.parse(alias, mode="eval").body for name, alias in aliases.items()}
        return annotated_type(ast.parse(text, mode="eval").body, trees)

    assert read("Positive | None") == Positive | None
    assert read("tuple[Side, ...]", Side="Annotated[int, Meta(ge=16)]") == tuple[Annotated[int, Meta(ge=16)], ...]
    assert read("Foreign | None") == "Foreign | None"
    assert read("__import__('os')") == "__import__('os')"


def nested(depth: int) -> list[object]:
    found: list[object] = []
    for _ in range(depth):
        found = [found]
    return found


def circle() -> list[object]:
    found: list[object] = []
    found.append(found)
    return found


@pytest.mark.parametrize(
    "value",
    [nested(10_000), circle(), {"a": nested(10_000)}, "x" * 10**6, [0] * 10**6, {1: {2: circle()}}, object()],
    ids=str.split("nested circle within text list inside object"),
)
@pytest.mark.parametrize("kind", [Finite, PositiveInt | None, Device, str, tuple[str, ...], tuple[int, ...], bool])
def test_any_value_is_refused_in_one_line(kind: Any, value: object) -> None:
    with pytest.raises(ConfigError) as error:
        converted(kind, value, "layer.x")
    assert len(str(error.value)) < 400
    assert "\n" not in str(error.value)
