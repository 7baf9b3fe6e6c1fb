"""Reads YAML that comes from outside: plain values, and no more of them than a document of ours can have.

Source: yaml.org/spec/1.1, as PyYAML resolves plain scalars; but a key is always text, and a date that
exists stays text.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import yaml

from .typed_documents import NOT_TEXT, InvalidDocument

_DEEPEST, _MOST_VALUES, _LONGEST_INT = 100, 1_000_000, 400
_PARSER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_TAG = "tag:yaml.org,2002:"
_RESOLVERS = yaml.SafeLoader.yaml_implicit_resolvers
_CONSTRUCTOR = yaml.constructor.SafeConstructor()
_NO_KEY, _MERGE = object(), object()
"""Stand for the key of a mapping that waits for its next key, and for ``<<``, which merges other mappings into it."""


def dump_yaml(content: Any) -> str:
    """The YAML text of plain values, which ``parse_yaml`` reads. Bytes that are not text, as names of files may hold
    them, become escapes such as ``\\udce9`` in words."""
    return yaml.safe_dump(_writable(content), sort_keys=False)


def _writable(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {_writable(key): _writable(inner) for key, inner in value.items()}
    return [_writable(inner) for inner in value] if isinstance(value, list | tuple) else value


def parse_yaml(text: str | bytes, is_float: Callable[[str], object] = lambda word: False) -> Any:
    """The value of a YAML text: None, bool, int of 64 bits, float, str, lists, and dicts by text.

    is_float: whether a plain word is a number although YAML 1.1 takes it for text. Aliases count as what they stand
    for. Raises InvalidDocument, which says where and what, as part of a sentence.
    """
    try:
        text = text if isinstance(text, str) else text.decode("utf-8-sig")
        return _Builder(is_float).build(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or str(error)
        raise InvalidDocument(f"line {mark.line + 1}: {problem}" if mark else " ".join(str(problem).split())) from error
    except UnicodeError as error:
        raise InvalidDocument(NOT_TEXT) from error


class _Builder:
    """Builds the values from the parser's events, without recursion."""

    def __init__(self, is_float: Callable[[str], object]):
        self._is_float = is_float
        self._count = 0
        self._documents: list[Any] = []
        self._open: list[Any] = [self._documents]
        self._keys: list[Any] = [None]
        self._anchors: list[tuple[str | None, int]] = []
        self._named: dict[str, tuple[Any, int]] = {}
        """Anchor -> its value, and how many values that is."""

    def build(self, text: str) -> Any:
        for event in yaml.parse(text, Loader=_PARSER):
            kind = type(event)
            if kind is yaml.ScalarEvent:
                self._scalar(event)
            elif kind is yaml.MappingStartEvent or kind is yaml.SequenceStartEvent:
                self._begin(event, {} if kind is yaml.MappingStartEvent else [])
            elif kind is yaml.MappingEndEvent or kind is yaml.SequenceEndEvent:
                self._end(event)
            elif kind is yaml.AliasEvent:
                self._alias(event)
            elif kind is yaml.DocumentStartEvent and self._documents:
                raise _invalid(event, "a second document begins")
        return self._documents[0] if self._documents else None

    def _scalar(self, event: Any) -> None:
        if self._keys[-1] is _NO_KEY:
            key = _MERGE if event.value == "<<" and event.implicit[0] else event.value
            if key in self._open[-1]:
                raise _invalid(event, f"the key '{event.value[:80]}' appears twice")
            self._keys[-1] = key
            self._counted(event, 1)
            return
        value = self._value(event)
        self._counted(event, 1)
        if event.anchor:
            self._named[event.anchor] = value, 1
        self._add(value)

    def _begin(self, event: Any, container: Any) -> None:
        if self._keys[-1] is _NO_KEY:
            raise _invalid(event, "a key is a list or a mapping instead of text")
        if event.tag not in (None, "!", _TAG + ("map" if isinstance(container, dict) else "seq")):
            raise _invalid(event, f"the tag {event.tag[:80]} is not read")
        if len(self._open) > _DEEPEST:
            raise _invalid(event, f"values are nested more than {_DEEPEST} deep")
        self._counted(event, 1)
        self._anchors.append((event.anchor, self._count))
        self._open.append(container)
        self._keys.append(_NO_KEY if isinstance(container, dict) else None)

    def _end(self, event: Any) -> None:
        value = self._open.pop()
        self._keys.pop()
        anchor, before = self._anchors.pop()
        if anchor:
            self._named[anchor] = value, self._count - before + 1
        if isinstance(value, dict) and _MERGE in value:
            _merge(event, value)
        self._add(value)

    def _alias(self, event: Any) -> None:
        if self._keys[-1] is _NO_KEY or event.anchor not in self._named:
            raise _invalid(event, f"the alias *{event.anchor[:80]} stands for nothing")
        value, size = self._named[event.anchor]
        self._counted(event, size)
        self._add(value)

    def _add(self, value: Any) -> None:
        container = self._open[-1]
        if isinstance(container, list):
            container.append(value)
            return
        key, self._keys[-1] = self._keys[-1], _NO_KEY
        container[key] = value

    def _counted(self, event: Any, values: int) -> None:
        self._count += values
        if self._count > _MOST_VALUES:
            raise _invalid(event, f"it holds more than {_MOST_VALUES:,} values")

    def _value(self, event: Any) -> Any:
        word, tag = event.value, event.tag
        if tag is None:
            if not event.implicit[0]:  # quoted
                return word
            candidates = _RESOLVERS.get(word[:1])
            tag = next((tag for tag, pattern in candidates or () if pattern.match(word)), None)
            if tag is None:
                return float(word) if self._is_float(word) else word
        if tag in ("!", f"{_TAG}str", f"{_TAG}value", f"{_TAG}merge"):
            return word
        if tag == f"{_TAG}int":
            return _whole_number(event, word)
        made = _MAKERS.get(tag)
        if made is None:
            raise _invalid(event, f"the tag {tag[:80]} is not read")
        try:
            return made(yaml.ScalarNode(tag, word))
        except (ValueError, KeyError, IndexError, OverflowError, AttributeError) as error:
            raise _invalid(event, f"'{word[:80]}' is not a {tag.removeprefix(_TAG)}") from error


def _merge(event: Any, own: dict[Any, Any]) -> None:
    """Put what ``<<`` names into a mapping; its own keys prevail, then those of the first."""
    merged = own.pop(_MERGE)
    for one in merged if isinstance(merged, list) else [merged]:
        if not isinstance(one, dict):
            raise _invalid(event, "'<<' merges what is not a mapping")
        for name, value in one.items():
            own.setdefault(name, value)


def _date(node: yaml.ScalarNode) -> str:
    """The text of a date that exists."""
    _CONSTRUCTOR.construct_yaml_timestamp(node)
    return str(node.value)


_MAKERS: dict[str, Callable[[yaml.ScalarNode], Any]] = {
    f"{_TAG}float": _CONSTRUCTOR.construct_yaml_float,
    f"{_TAG}bool": _CONSTRUCTOR.construct_yaml_bool,
    f"{_TAG}null": _CONSTRUCTOR.construct_yaml_null,
    f"{_TAG}timestamp": _date,
}


def _whole_number(event: Any, word: str) -> int:
    if len(word) < 19 and word.isascii() and word.isdigit() and (word[0] != "0" or word == "0"):
        return int(word)
    try:
        value = int(_CONSTRUCTOR.construct_yaml_int(yaml.ScalarNode("", word))) if len(word) < _LONGEST_INT else 1 << 64
    except (ValueError, IndexError) as error:
        raise _invalid(event, f"'{word[:80]}' is not a whole number") from error
    if not -(1 << 63) <= value < 1 << 64:
        raise _invalid(event, f"the whole number {word[:20]}… has more than 64 bits")
    return value


def _invalid(event: Any, what: str) -> InvalidDocument:
    return InvalidDocument(f"line {event.start_mark.line + 1}: {what}")
