"""Documents from outside: JSON that is refused with a reason, and types that are checked with the field."""

import json

import msgspec
import pytest

from freeocc3d.core.typed_documents import InvalidDocument, as_type, parse_json


class Cup(msgspec.Struct):
    name: str
    sizes: dict[str, float]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"a": ', "line 1: Expecting value"),
        ("[" * 200 + "]" * 200, "nested more than 100 deep"),
        ("[" * 100_000, "nested more than 100 deep"),
        ('{"a":' * 150 + "1" + "}" * 150, "nested more than 100 deep"),
        ("9" * 5000, "a whole number of too many digits"),
        (b'"\xff"', "not text in UTF-8"),
        ("", "line 1"),
        ("\ufeff1", "line 1"),
    ],
)
def test_what_is_no_json_is_refused(text: str | bytes, said: str) -> None:
    with pytest.raises(InvalidDocument, match=said):
        parse_json(text)


def test_python_s_own_json_is_read() -> None:
    content = {"a": [1, 2.5, None, float("inf"), {"b": "é"}]}
    assert parse_json(json.dumps(content)) == content


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([], "it has a list instead of a group of keys"),
        ({"sizes": {}}, "it lacks 'name'"),
        ({"name": "x", "sizes": {"a": "big"}}, "'sizes.*' has text instead of a number"),
        ({"name": "x", "sizes": {"a": 10**5000}}, "too large"),
    ],
)
def test_another_type_is_named_with_the_field(content: object, said: str) -> None:
    with pytest.raises(InvalidDocument, match=said):
        as_type(content, Cup)
