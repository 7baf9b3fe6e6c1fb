"""The types of options: numbers with ranges, choices, and the words for a type in messages.

The annotation of an option holds its range, so one declaration checks values, explains errors and documents the
option::

    voxel_size: Positive = 0.08
    stop: NotNegativeInt | None = None
    order: Literal["auto", "video", "photos"] = "auto"
    cutoff: Advanced[Positive] = 3.0

All number types refuse infinity and NaN.
"""

from __future__ import annotations

import ast
import contextlib
import math
import numbers
import sys
import types
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import Meta

from ..core.errors import ConfigError

T = TypeVar("T")

_LARGEST = sys.float_info.max

Finite = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST)]
Positive = Annotated[float, Meta(gt=0, le=_LARGEST)]
NotNegative = Annotated[float, Meta(ge=0, le=_LARGEST)]
Share = Annotated[float, Meta(ge=0, le=1)]
PositiveShare = Annotated[float, Meta(gt=0, le=1)]
Cosine = Annotated[float, Meta(ge=-1, le=1)]
PositiveInt = Annotated[int, Meta(ge=1)]
NotNegativeInt = Annotated[int, Meta(ge=0)]

Advanced = Annotated[T, Meta(extra={"advanced": True})]
"""An option that is only for comparisons with other methods; ``freeocc3d list`` shows it only on request."""

_NOUNS = {
    float: ("a number", "numbers"),
    int: ("a whole number", "whole numbers"),
    str: ("text", "text values"),
    bool: ("true or false", "values true or false"),
    type(None): ("null", "nulls"),
}
_NAMES = {
    "Advanced": Advanced, "Annotated": Annotated, "Cosine": Cosine, "Finite": Finite, "Literal": Literal, "Meta": Meta,
    "NotNegative": NotNegative, "NotNegativeInt": NotNegativeInt, "Positive": Positive, "PositiveInt": PositiveInt,
    "PositiveShare": PositiveShare, "Share": Share, "bool": bool, "float": float, "int": int, "str": str,
    "tuple": tuple,
}  # fmt: skip
"""The names that an option's annotation may contain."""


def converted(kind: Any, value: Any, name: str) -> Any:
    """Converts ``value`` to the type ``kind``: whole numbers become floats for a float type, lists become tuples.

    name: the option's name in messages, such as "occupancy.voxel_size". Raises ConfigError for a value of another type
    or out of its range.
    """
    try:
        plain = _plain(value)
        if not _is_finite(plain):
            raise msgspec.ValidationError
        return msgspec.convert(plain, kind)
    except msgspec.ValidationError:
        raise ConfigError(f"'{name}' must be {_expected(kind, value)}, got {_shown(value)}.") from None


def described(kind: Any) -> str:
    """Describes a type in words, such as "a number greater than 0 or null"."""
    return _listed(_alternatives(kind))


def is_advanced(kind: Any) -> bool:
    """Whether the type is declared as ``Advanced``."""
    metas = [part for part in getattr(kind, "__metadata__", ()) if isinstance(part, Meta)]
    return any((meta.extra or {}).get("advanced") for meta in metas)


def holds_text(kind: Any) -> bool:
    """Whether the type, or the type of its items, includes text."""
    base = _base(kind)
    return base is str or any(holds_text(part) for part in get_args(base))


def is_list(kind: Any) -> bool:
    """Whether the type's values are lists."""
    return any(get_origin(_base(part)) is tuple for part in _parts(kind))


def annotated_type(annotation: ast.expr, aliases: dict[str, ast.expr]) -> Any:
    """The type that an annotation in a syntax tree means, or its source text if that is unknown.

    aliases: the names that its module assigns, such as ``Form = Literal["cubes", "points"]``.
    """
    with contextlib.suppress(NameError, TypeError, SyntaxError):
        known = {name: annotated_type(alias, {}) for name, alias in aliases.items()}
        code = compile(ast.Expression(annotation), "<annotation>", "eval")
        return eval(code, {"__builtins__": {}}, {**known, **_NAMES})
    return ast.unparse(annotation)


def _plain(value: Any) -> Any:
    """Converts numpy numbers in the value to Python numbers."""
    if type(value) in (bool, int, float, str, type(None)):
        return value
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, numbers.Integral):
        return int(value)
    return float(value) if isinstance(value, numbers.Real) else value


def _is_finite(plain: Any) -> bool:
    if isinstance(plain, list):
        return all(map(_is_finite, plain))
    return not isinstance(plain, float) or math.isfinite(plain)


def _base(kind: Any) -> Any:
    """The type without its annotations."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _parts(kind: Any) -> tuple[Any, ...]:
    """The alternatives of a union, None last; otherwise the type itself."""
    base = _base(kind)
    if get_origin(base) in (Union, types.UnionType):
        return tuple(sorted(get_args(base), key=lambda part: part is type(None)))
    return (kind,)


def _alternatives(kind: Any) -> list[str]:
    if isinstance(kind, str):
        return [kind]
    texts: list[str] = []
    for part in _parts(kind):
        base = _base(part)
        if get_origin(base) is Literal:
            texts += [str(choice) for choice in get_args(base)]
        elif get_origin(base) is tuple:
            texts.append(_described_list(base))
        else:
            texts.append(_with_range(_NOUNS[base][0], part))
    return texts


def _described_list(kind: Any) -> str:
    items = get_args(kind)
    noun = _NOUNS[_base(items[0])][1]
    count = "" if items[-1] is Ellipsis else f"{len(items)} "
    return f"a list of {count}{_with_range(noun, items[0])}"


def _range(kind: Any) -> str:
    """The range of a number in words; empty if every finite number is allowed."""
    metas = [part for part in getattr(kind, "__metadata__", ()) if isinstance(part, Meta)]
    low = next((f"at least {meta.ge:g}" for meta in metas if meta.ge is not None and meta.ge > -_LARGEST), "")
    low = next((f"greater than {meta.gt:g}" for meta in metas if meta.gt is not None), low)
    high = next((f"at most {meta.le:g}" for meta in metas if meta.le is not None and meta.le < _LARGEST), "")
    high = next((f"less than {meta.lt:g}" for meta in metas if meta.lt is not None), high)
    between = next((f"from {meta.ge:g} to {meta.le:g}" for meta in metas if meta.ge is not None and high), "")
    return between if between and low else " and ".join(filter(None, (low, high)))


def _with_range(noun: str, kind: Any) -> str:
    limits = _range(kind)
    return " ".join(filter(None, (noun, "of" if limits.startswith("at ") else "", limits)))


def _listed(texts: list[str]) -> str:
    return " or ".join(filter(None, (", ".join(texts[:-1]), texts[-1])))


def _expected(kind: Any, value: Any) -> str:
    """Describes the expected value; for a number out of range, only the range."""
    plain = _plain(value)
    if isinstance(plain, float) and not math.isfinite(plain):
        return "a finite number"
    if isinstance(plain, int | float) and not isinstance(plain, bool):
        for part in _parts(kind):
            base = _base(part)
            fits = base is float or (base is int and isinstance(plain, int))
            if fits and (limits := _range(part)):
                return limits
    return described(kind)


def _shown(value: Any) -> str:
    plain = _plain(value)
    if plain is None or isinstance(plain, bool):
        return {None: "null", True: "true", False: "false"}[plain]
    return repr(plain)
