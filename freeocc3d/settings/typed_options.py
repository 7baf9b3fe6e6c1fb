"""The base of every options class: frozen, with declared types and ranges that are always checked.

A subclass declares its fields with the types of ``option_types`` and gives each field a default and a docstring::

    class Options(TypedOptions, frozen=True):
        stride: PositiveInt = 4
        \"\"\"Every n-th pixel is used.\"\"\"

Classes that share options inherit them. A class checks rules between several options in ``__post_init__``, after
"""

from __future__ import annotations

import difflib
import functools
import re
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar, get_type_hints

import msgspec

from ..core.errors import ConfigError
from .option_types import converted, shown

_LONGEST_NAME = 100


class TypedOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of one stage or backend. Raises ConfigError for a value of another type or out of its range."""

    def __post_init__(self) -> None:
        for name, kind in field_types(type(self)).items():
            converted(kind, getattr(self, name), name)

    def changed(self: O, **values: Any) -> O:
        """Returns a copy with other values, which are checked."""
        return build(type(self), {**msgspec.structs.asdict(self), **values})

    def to_dict(self) -> dict[str, Any]:
        """All options, name -> value."""
        return msgspec.structs.asdict(self)


O = TypeVar("O", bound=TypedOptions)  # noqa: E741


@functools.cache
def field_types(options: type[TypedOptions]) -> dict[str, Any]:
    """Name -> type of each option of a class; inherited options come first."""
    hints = get_type_hints(options, include_extras=True)
    return {name: hints[name] for name in options.__struct_fields__}


def build(options: type[O], values: Mapping[str, Any], where: str = "") -> O:
    """Makes options from plain values; an option that is not given has its default.

    where: the text before a key in messages, such as "occupancy.". Raises ConfigError for an unknown key (suggesting
    the nearest) and for a value of another type or out of its range.
    """
    types = field_types(options)
    for key in values:
        if key not in types:
            raise ConfigError(f"Unknown key '{where}{shortened(key)}'{nearest(key, types)}.")
    checked = {name: converted(types[name], value, f"{where}{name}") for name, value in values.items()}
    try:
        return options(**checked)
    except ConfigError as error:
        named = re.sub(r"'(\w+)'", lambda found: f"'{where}{found[1]}'" if found[1] in types else found[0], str(error))
        raise ConfigError(named) from None


def shortened(name: object) -> str:
    """A name of unknown kind and length, as messages show it in one line."""
    text = name if isinstance(name, str) else shown(name)
    return text if len(text) <= _LONGEST_NAME and text.isprintable() else repr(text[:_LONGEST_NAME])[1:-1] + "…"


def nearest(word: object, known: Iterable[str], least: float = 0.5) -> str:
    """Returns ``" (did you mean 'x'?)"`` for the nearest known word, or an empty string. least: of difflib's ratio,
    0…1."""
    close = difflib.get_close_matches(shortened(word), list(known), n=1, cutoff=least)
    return f" (did you mean '{close[0]}'?)" if close else ""
