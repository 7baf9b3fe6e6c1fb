"""Warnings about a run: a code for programs and a text for people."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

from .errors import printable

Code = Literal[
    "option-renamed",
    "option-removed",
    "option-clamped",
    "options-unsuited",
    "images-left-out",
    "images-unreadable",
    "depth-scale-doubtful",
    "depth-empty",
    "images-dark",
    "depth-not-read",
    "poses-doubtful",
    "registration-doubtful",
    "intrinsics-unknown",
    "extrinsics-unknown",
    "focal-estimated",
    "color-focal-corrected",
    "models-apart",
    "broken-frames",
    "frames-lost",
    "poses-missing",
    "submaps-apart",
    "scale-unknown",
    "vocabulary-incomplete",
    "vocabulary-empty-answers",
    "checkpoint-damaged",
    "uncoded",
]
"""What a warning is about. "uncoded" is a warning of an older map, where warnings are plain texts."""


class Notice(NamedTuple):
    """One warning. text: sentences that say what happened and what to do."""

    code: Code
    text: str

    def to_dict(self) -> dict[str, str]:
        """The form in report.json."""
        return {"code": self.code, "text": printable(self.text)}


def read_notices(stored: Iterable[Any]) -> list[Notice]:
    """The inverse of ``Notice.to_dict`` for a list. The plain texts of older maps become "uncoded"."""
    return [Notice("uncoded", one) if isinstance(one, str) else Notice(one["code"], one["text"]) for one in stored]
