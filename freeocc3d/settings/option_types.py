"""The types of options: numbers with ranges, choices, and the words for a type in messages.

The annotation of an option holds its range, so one declaration checks values, explains errors and documents the
option::

    voxel_size: Positive = 0.08
    stop: NotNegativeInt | None = None
    order: Literal["auto", "video", "photos"] = "auto"
    cutoff: Advanced[Positive] = 3.0

All numbers have bounds: those that declare no narrower range end at 1e9, and positive ones begin at 1e-9. Text has at
most 4096 characters, none of them NUL.
"""

from __future__ import annotations

import ast
import contextlib
import math
import numbers
import reprlib
import types
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import Meta

from ..core.errors import ConfigError

T = TypeVar("T")

_LEAST = 1e-9
_LARGEST = 10**9
"""Bounds of numbers that declare no narrower range; descriptions of types leave them out."""
_LONGEST_TEXT = 4096
_LONGEST_LIST = 10_000

Finite = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST)]
Positive = Annotated[float, Meta(ge=_LEAST, le=_LARGEST)]
NotNegative = Annotated[float, Meta(ge=0, le=_LARGEST)]
Share = Annotated[float, Meta(ge=0, le=1)]
PositiveShare = Annotated[float, Meta(gt=0, le=1)]
Cosine = Annotated[float, Meta(ge=-1, le=1)]
Meters = Annotated[float, Meta(ge=0.0001, le=1000)]
VoxelEdge = Annotated[float, Meta(ge=0.001, le=100)]
PositiveInt = Annotated[int, Meta(ge=1, le=_LARGEST)]
NotNegativeInt = Annotated[int, Meta(ge=0, le=_LARGEST)]
Stride = Annotated[int, Meta(ge=1, le=4096)]
Seed = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Device = Annotated[
    str, Meta(pattern="^[A-Za-z]+(:[0-9]{1,3})?$", max_length=32, description="a device such as cpu or cuda:0")
]
FilePath = Annotated[str, Meta(min_length=1, description="a path")]

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
    "Advanced": Advanced, "Annotated": Annotated, "Cosine": Cosine, "Device": Device, "FilePath": FilePath,
    "Finite": Finite, "Literal": Literal, "Meta": Meta, "Meters": Meters, "NotNegative": NotNegative,
    "NotNegativeInt": NotNegativeInt, "Positive": Positive, "PositiveInt": PositiveInt, "PositiveShare": PositiveShare,
    "Seed": Seed, "Share": Share, "Stride": Stride, "VoxelEdge": VoxelEdge, "bool": bool, "float": float, "int": int,
    "str": str, "tuple": tuple,
}  # fmt: skip
"""The names that an option's annotation may contain."""


def converted(kind: Any, value: Any, name: str) -> Any:
    """Converts ``value`` to the type ``kind``: whole numbers become floats for a float type, lists become tuples.

    name: the option's name in messages, such as "occupancy.voxel_size". Raises ConfigError for a value of another type
    or out of its range.
    """
    try:
        plain = _plain(value)
        items = plain if isinstance(plain, list) else [plain]
        if len(items) > _LONGEST_LIST or not all(map(_is_usable, items)):
            raise msgspec.ValidationError
        return msgspec.convert(plain, kind)
    except msgspec.ValidationError:
        raise ConfigError(f"'{name}' must be {_expected(kind, value)}, got {shown(value)}.") from None


def clamped(kind: Any, value: Any) -> Any:
    """A number that is out of the range of its type, at the nearest end of it; any other value as it is."""
    if not _is_number(value) or not math.isfinite(value):
        return value
    for part in _parts(kind):
        if _base(part) is float or (_base(part) is int and isinstance(value, int)):
            for meta in _metas(part):
                value = meta.ge if meta.ge is not None and value < meta.ge else value
                value = meta.le if meta.le is not None and value > meta.le else value
            return value
    return value


def described(kind: Any) -> str:
    """Describes a type in words, such as "a number greater than 0 or null"."""
    return _listed(_alternatives(kind))


def is_advanced(kind: Any) -> bool:
    """Whether the type is declared as ``Advanced``."""
    return any((meta.extra or {}).get("advanced") for meta in _metas(kind))


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


def _plain(value: Any, inside: bool = False) -> Any:
    """Converts numpy numbers in the value to Python numbers. inside: the value is an item; lists in it stay."""
    if type(value) in (bool, int, float, str, type(None)):
        return value
    if isinstance(value, list | tuple) and not inside:
        return [_plain(item, inside=True) for item in value[: _LONGEST_LIST + 1]]
    if isinstance(value, numbers.Integral):
        return int(value)
    return float(value) if isinstance(value, numbers.Real) else value


def _is_usable(plain: Any) -> bool:
    """Whether a value that is no list can be an option's at all."""
    return math.isfinite(plain) if isinstance(plain, float) else not isinstance(plain, str) or is_text(plain)


def is_text(text: str) -> bool:
    """Whether options, file names and servers can hold a text: it is not too long, holds no NUL, and is Unicode."""
    return len(text) <= _LONGEST_TEXT and "\0" not in text and not any("\ud800" <= char <= "\udfff" for char in text)


def _base(kind: Any) -> Any:
    """The type without its annotations."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _parts(kind: Any) -> tuple[Any, ...]:
    """The alternatives of a union, None last; otherwise the type itself."""
    base = _base(kind)
    if get_origin(base) in (Union, types.UnionType):
        return tuple(sorted(get_args(base), key=lambda part: part is type(None)))
    return (kind,)


def _alternatives(kind: Any, value: Any = None) -> list[str]:
    """What fits, in words. value: what was given in its place, see ``_range``."""
    if isinstance(kind, str):
        return [kind]
    texts: list[str] = []
    for part in _parts(kind):
        base = _base(part)
        said = next((meta.description for meta in _metas(part) if meta.description), None)
        if said is not None:
            texts.append(said)
        elif get_origin(base) is Literal:
            texts += [str(choice) for choice in get_args(base)]
        elif get_origin(base) is tuple:
            texts.append(_described_list(base, value))
        else:
            texts.append(_with_range(_NOUNS[base][0], part, value))
    return texts


def _described_list(kind: Any, value: Any) -> str:
    items = get_args(kind)
    noun = _NOUNS[_base(items[0])][1]
    count = "" if items[-1] is Ellipsis else f"{len(items)} "
    given = [item for item in value if _is_number(item)] if isinstance(value, list) else []
    return f"a list of {count}{_with_range(noun, items[0], max(given, key=abs, default=None))}"


def _metas(kind: Any) -> list[Meta]:
    return [part for part in getattr(kind, "__metadata__", ()) if isinstance(part, Meta)]


def _range(kind: Any, value: Any = None) -> str:
    """The range of a number in words; empty if it has only the bounds of all numbers. value: one that does not fit; if
    it is beyond those bounds, they are named too."""
    bounds = {name: next((getattr(m, name) for m in _metas(kind) if getattr(m, name) is not None), None) for name in (
        "gt", "ge", "lt", "le"
    )}  # fmt: skip
    gt, ge, lt, le = bounds.values()
    beyond = _is_number(value) and abs(value) > _LARGEST
    if le == _LARGEST and not beyond:
        le = None
    if ge == -_LARGEST and not beyond:
        ge = None
    if ge == _LEAST and not beyond and not (_is_number(value) and 0 < value < _LEAST):
        gt, ge = 0, None
    if ge is not None and le is not None:
        return f"from {_number(ge)} to {_number(le)}"
    low = f"greater than {_number(gt)}" if gt is not None else f"at least {_number(ge)}" if ge is not None else ""
    high = f"less than {_number(lt)}" if lt is not None else f"at most {_number(le)}" if le is not None else ""
    return " and ".join(filter(None, (low, high)))


def _number(bound: float) -> str:
    return str(bound) if isinstance(bound, int) and abs(bound) != _LARGEST else f"{bound:g}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _with_range(noun: str, kind: Any, value: Any) -> str:
    limits = _range(kind, value)
    return " ".join(filter(None, (noun, "of" if limits.startswith("at ") else "", limits)))


def _listed(texts: list[str]) -> str:
    return " or ".join(filter(None, (", ".join(texts[:-1]), texts[-1])))


def _expected(kind: Any, value: Any) -> str:
    """Describes the expected value; for a number out of range, only the range."""
    plain = _plain(value)
    if isinstance(plain, float) and not math.isfinite(plain):
        return "a finite number"
    if _is_number(plain):
        for part in _parts(kind):
            base = _base(part)
            fits = base is float or (base is int and isinstance(plain, int))
            if fits and (limits := _range(part, plain)):
                return limits
    texts = [item for item in (plain if isinstance(plain, list) else [plain]) if isinstance(item, str)]
    if not all(map(is_text, texts)):
        return f"text of at most {_LONGEST_TEXT} characters in UTF-8, without NUL"
    if isinstance(plain, list) and len(plain) > _LONGEST_LIST:
        return f"a list of at most {_LONGEST_LIST} values"
    return _listed(_alternatives(kind, plain))


class _Short(reprlib.Repr):
    """``repr`` of at most a line, for any value."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = 120
        self.maxlist = self.maxtuple = self.maxdict = 8
        self.maxlevel = 3

    def repr_int(self, x: int, level: int) -> str:
        digits = int(x.bit_length() * math.log10(2))
        return str(x) if digits < 30 else f"about {'-' * (x < 0)}1e{digits}"


_SHORT = _Short()


def shown(value: Any) -> str:
    """A value of any kind and size as a message shows it, in one line of bounded length."""
    plain = _plain(value)
    if plain is None or isinstance(plain, bool):
        return {None: "null", True: "true", False: "false"}[plain]
    return _SHORT.repr(plain)
