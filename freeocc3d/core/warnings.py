"""What a user should know of a run: a code by which programs recognize it, and a text for people."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

Code = Literal[
    "images-left-out",
    "depth-scale-doubtful",
    "intrinsics-unknown",
    "color-focal-corrected",
    "models-apart",
    "broken-frames",
    "frames-lost",
    "submaps-apart",
    "scale-unknown",
    "vocabulary-incomplete",
    "vocabulary-empty-answers",
    "uncoded",
]
"""What a warning is about; "uncoded" are those of maps that were made when warnings were plain texts."""


class Notice(NamedTuple):
    """One warning. text: sentences that say what happened and what can be done."""

    code: Code
    text: str

    def to_dict(self) -> dict[str, str]:
        """As report.json keeps it."""
        return {"code": self.code, "text": self.text}


def read_notices(stored: Iterable[Any]) -> list[Notice]:
    """The inverse of ``Notice.to_dict`` for a whole list; plain texts, which older maps hold, are "uncoded"."""
    return [Notice("uncoded", one) if isinstance(one, str) else Notice(one["code"], one["text"]) for one in stored]
