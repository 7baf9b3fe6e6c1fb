"""Documents from outside, as values of a type: what they hold is checked once, and reported with the field."""

from __future__ import annotations

import json
import re
from collections import Counter
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")

_DEEPEST = 100
_HALF_CHARACTER = re.compile(r"\\u[dD][89a-fA-F]")
NOT_TEXT = "it holds bytes that are not text in UTF-8"
_TOO_DEEP = f"its values are nested more than {_DEEPEST} deep"


class InvalidDocument(ValueError):
    """A document is not JSON or YAML of plain values, or its content has another type. The message is part of a
    sentence."""


def parse_json(text: str | bytes, finite: bool = False) -> Any:
    """The value of a JSON text, at most 100 deep; as Python writes it, with NaN and Infinity unless ``finite``. Raises
    InvalidDocument, also for a name that appears twice in an object, and for half a character."""
    refuse = _refuse_constant if finite else None
    try:
        value = json.loads(text, object_pairs_hook=_unique, parse_constant=refuse)
        if _HALF_CHARACTER.search(text if isinstance(text, str) else text.decode("utf-8", "replace")):
            json.dumps(value, ensure_ascii=False).encode()  # a surrogate alone could never be written again
    except InvalidDocument:
        raise
    except json.JSONDecodeError as error:
        raise InvalidDocument(f"line {error.lineno}: {error.msg}") from error
    except ValueError as error:  # not UTF-8, or a whole number of thousands of digits
        raise InvalidDocument(f"{NOT_TEXT}, or a whole number of too many digits") from error
    except RecursionError as error:
        raise InvalidDocument(_TOO_DEEP) from error
    level = [value]
    for _ in range(_DEEPEST):
        level = [inner for outer in level for inner in _inner(outer) if isinstance(inner, list | dict)]
        if not level:
            return value
    raise InvalidDocument(_TOO_DEEP)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = Counter(name for name, _ in pairs)
        raise InvalidDocument(f"'{names.most_common(1)[0][0][:80]}' appears twice")
    return found


def _refuse_constant(name: str) -> None:
    raise InvalidDocument(f"it holds {name} instead of a number")


def _inner(outer: Any) -> Any:
    if isinstance(outer, dict):
        return outer.values()
    return outer if isinstance(outer, list) else ()


def as_type(content: Any, kind: type[T]) -> T:
    """The content as a value of a type that msgspec knows. Raises InvalidDocument with the field."""
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        raise InvalidDocument(_what_is_wrong(error)) from error
    except (RecursionError, OverflowError) as error:
        raise InvalidDocument("a value is too large") from error


_KINDS = {
    "float": "a number", "int": "a whole number", "str": "text", "bool": "true or false", "array": "a list",
    "object": "a group of keys", "null": "nothing",
}  # fmt: skip
_SHAPES = (
    (r"Object missing required field `(?P<key>\w+)`", "lacks '{key}'"),
    (r"Expected `(?P<wanted>[^`]+)`, got `(?P<found>\w+)`", "has {found} instead of {wanted}"),
    (r"Expected `array` of length (?P<wanted>\d+), got (?P<found>\d+)", "has {found} entries instead of {wanted}"),
    (r"Expected `\w+` (?P<bound>[<>]=? \S+)", "has a number that is not {bound}"),
    (r"Number out of range", "has a number that is too large"),
)


def _what_is_wrong(error: msgspec.ValidationError) -> str:
    """A validation error as part of a sentence that names the field."""
    message, _, where = str(error).partition(" - at `$")
    field = where.strip("`.")
    for pattern, sentence in _SHAPES:
        if match := re.fullmatch(pattern, message):
            said = {name: _in_words(value) for name, value in match.groupdict().items()}
            return f"{repr(field) if field else 'it'} {sentence.format(**said)}"
    return f"'{field}': {message}"


def _in_words(kinds: str) -> str:
    return " or ".join(_KINDS.get(kind, kind) for kind in kinds.split(" | "))
