"""YAML from outside: the values that PyYAML gives, and a sentence for everything that is more than plain values."""

import os
import random
from pathlib import Path

import pytest
import yaml

from freeocc3d.core.regular_files import stored_path
from freeocc3d.core.typed_documents import InvalidDocument
from freeocc3d.core.yaml_documents import dump_yaml, parse_yaml

SOUND = (
    "",
    "a: 1\nb: [1.5, -2, .inf, 1.0e-05, ~, null, yes, off, True]\nc: {d: 'e', \"f\": g}\n",
    "[0x1F, 0b101, 017, 1_000, 1:30, +12, -0, 0, 00, 1:30.5, 12e03, 1e3, .5, 5.]",
    "a: &x [1, 2]\nb: *x\nc: {<<: {d: 1}, d: 2}\n",
    "base: &b {p: 1, q: 2}\nuse: {q: 3, <<: *b}\nmany: {<<: [*b, {r: 4}]}\n",
    "a: |\n  two\n  lines\nb: >-\n  one\n  line\n",
    "!!str 12",
    "[!!int 12, !!float 3, !!bool yes, !!null '', !!seq [1], !!map {a: 1}]",
    "- y\n- é\n- '<<'\n- '='",
)


@pytest.mark.parametrize("text", SOUND)
def test_sound_texts_have_the_values_that_pyyaml_gives(text: str) -> None:
    assert parse_yaml(text) == yaml.safe_load(text)


def test_what_pyyaml_writes_is_read() -> None:
    rng = random.Random(3)
    words = [
        "1e5",
        "yes",
        "0x1",
        "2024-01-01",
        "a: b",
        "'",
        '"',
        "\n",
        "",
        " x ",
        "é",
        "-",
        "{",
        "<<",
        "=",
        "1:30",
        "~",
    ]

    def value(depth: int) -> object:
        if depth and rng.random() < 0.5:
            return [value(depth - 1) for _ in range(rng.randrange(4))]
        if depth:
            return {rng.choice(words): value(depth - 1) for _ in range(rng.randrange(4))}
        return rng.choice([*words, None, True, 3, -7, 1.5, 1e-9, float("inf"), 2**63])

    for _ in range(300):
        content = value(3)
        assert parse_yaml(yaml.safe_dump(content)) == content


def test_keys_and_dates_are_text() -> None:
    assert parse_yaml("1: a\nyes: b\n2024-01-01: 2024-01-01") == {"1": "a", "yes": "b", "2024-01-01": "2024-01-01"}
    assert parse_yaml("d: '2024-13-45'\ne: =") == {"d": "2024-13-45", "e": "="}
    for impossible in ("d: 2024-13-45", "d: !!timestamp x"):
        with pytest.raises(InvalidDocument, match=r"line 1: '.*' is not a timestamp"):
            parse_yaml(impossible)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\na: 2", "line 2: the key 'a' appears twice"),
        ("a:\n  - !!int abc", "line 2: 'abc' is not a whole number"),
        ("!!float x", "'x' is not a float"),
        ("!!bool x", "'x' is not a bool"),
        ("!!binary x", "tag"),
        ("!!timestamp {}", "tag"),
        ("!!set {a}", "tag"),
        ("!!python/object/apply:os.system ['true']", "tag"),
        ("!own 3", "tag"),
        ("a: " + "9" * 5000, "more than 64 bits"),
        ("a: -9999999999999999999999", "more than 64 bits"),
        ("a: 0x" + "f" * 17, "more than 64 bits"),
        ("[" * 500, "line 1"),
        ("- " * 5000, "nested more than 100 deep"),
        ("{a: " * 200, "nested"),
        ("? [a]\n: b", "a key is a list"),
        ("{[a]: b}", "a key is a list"),
        ("a: &a [*a]", "stands for nothing"),
        ("a: *b", "undefined alias|stands for nothing"),
        ("&a b: 1\n*a : 2", "stands for nothing"),
        ("a: 1\n---\nb: 2", "line 2: a second document"),
        ("a: {<<: 3}", "merges"),
        ("a: [1, 2", "line"),
        ("a: \x00", "."),
        ("a: \ud800", "not text"),
        ("\t- x\n a", "line"),
    ],
)
def test_what_is_more_than_plain_values_is_refused_with_the_line(text: str, said: str) -> None:
    with pytest.raises(InvalidDocument, match=said) as raised:
        parse_yaml(text)
    assert "\n" not in str(raised.value)


def test_bytes_are_text_in_utf_8_with_or_without_a_mark() -> None:
    for data in ("a: é".encode(), "a: é".encode("utf-8-sig")):
        assert parse_yaml(data) == {"a": "é"}
    with pytest.raises(InvalidDocument, match="bytes that are not text in UTF-8"):
        parse_yaml(b"a: \xe9")


def test_laughs_are_counted() -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    with pytest.raises(InvalidDocument, match="more than 1,000,000 values"):
        parse_yaml("\n".join(lines))
    assert len(parse_yaml("\n".join(lines[:4]))) == 4


def test_names_that_are_not_text_are_written_as_escapes(tmp_path: Path) -> None:
    """The path that a document states leads to the file all the same."""
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    read = parse_yaml(dump_yaml({"path": str(folder), "more": [{"b": ("é", 1, None)}]}))
    assert read == {"path": f"{tmp_path}/caf\\udce9", "more": [{"b": ["é", 1, None]}]}
    assert stored_path(read["path"]) == folder
    literal = tmp_path / "caf\\udce9"
    literal.mkdir()
    assert stored_path(read["path"]) == literal
