"""Lets a command take its options in records, one for each group of its help page."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from copy import copy
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, get_args, get_type_hints

from typer.models import OptionInfo


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """The command for Typer: the fields of a dataclass, which are ``Annotated`` options or arguments, replace the
    parameter of that type. The first line of the dataclass's docstring names the group on the help page."""
    hints = get_type_hints(command, include_extras=True)
    records: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    flat: list[inspect.Parameter] = []
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name in records:
            flat += _parameters(records[parameter.name])
        else:
            flat.append(parameter.replace(annotation=hints[parameter.name], kind=inspect.Parameter.KEYWORD_ONLY))

    @functools.wraps(command)
    def called(**values: Any) -> None:
        made = {
            name: record(**{field.name: values.pop(field.name) for field in fields(record)})
            for name, record in records.items()
        }
        command(**made, **values)

    called.__signature__ = inspect.Signature(flat)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in flat}
    return called


def _parameters(record: Any) -> list[inspect.Parameter]:
    """The fields of a dataclass as parameters in the group that its docstring names."""
    hints = get_type_hints(record, include_extras=True)
    group = (record.__doc__ or "").split("\n", 1)[0].rstrip(".")
    parameters = []
    for field in fields(record):
        kind, described = get_args(hints[field.name])
        described = copy(described)
        if isinstance(described, OptionInfo):  # arguments have a group of their own
            described.rich_help_panel = group
        default = inspect.Parameter.empty if field.default is MISSING else field.default
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters.append(
            inspect.Parameter(field.name, keyword, default=default, annotation=Annotated[kind, described])
        )
    return parameters
