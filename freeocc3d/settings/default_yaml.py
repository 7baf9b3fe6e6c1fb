"""Writes ``configs/default.yaml``, a configuration with every option, its default and what it does:

python -m freeocc3d.settings.default_yaml > configs/default.yaml
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable

from . import registry, stages
from .config import SECTIONS
from .syntax_trees import Option, options_of

_HEAD = """\
# Every option with its default. Your own file needs only the keys that it changes.
# Options marked (advanced) are for comparisons with other methods. Keep their defaults otherwise.
"""


def default_yaml() -> str:
    """The text of the file."""
    lines = []
    for name, section in SECTIONS.items():
        if section.within:
            continue
        lines += ["", f"{name}:"]
        lines += _lines(options_of(stages.__name__, section.options.__name__), indent=2)
        for backend in registry.backends(section.folder).values() if section.folder else ():
            if backend.options and backend.module.startswith("freeocc3d."):
                lines += [f"  {backend.name}:  # {backend.summary}", *_lines(backend.options, indent=4)]
        for inner, other in SECTIONS.items():
            if other.within == name:
                lines.append(f"  {inner}:  # {(other.options.__doc__ or '').splitlines()[0]}")
                lines += _lines(options_of(stages.__name__, other.options.__name__), indent=4)
    return _HEAD + "\n".join(lines) + "\n"


def _lines(options: Iterable[Option], indent: int) -> Iterable[str]:
    for option in options:
        doc = f"(advanced) {option.doc}" if option.advanced else option.doc
        yield from (" " * indent + f"# {line}" for line in textwrap.wrap(doc, 118 - indent))
        yield " " * indent + f"{option.name}: {json.dumps(option.default)}"


if __name__ == "__main__":
    print(default_yaml(), end="")
