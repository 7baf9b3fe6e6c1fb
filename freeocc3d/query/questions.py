"""A question to a map in one record, and its answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .conditions import Where
from .word_query import QueryResult

if TYPE_CHECKING:
    from .scan_map import Map


@dataclass(frozen=True)
class Question:
    """A question to a map; all parts may be combined.

    words: words or phrases.  negative: words for what these do not mean.  classes: names of the map's vocabulary.
    image: a picture.  image_box: x0, y0, x1, y1, the pixels of the picture that count, with the last included.
    where: conditions on the places of regions.  objects: whether the answers are whole objects first; None = to words
    and pictures, if the map keeps its objects.
    options: fields of ``word_query.Options``.
    """

    words: Sequence[str] = ()
    negative: Sequence[str] = ()
    classes: Sequence[str] = ()
    image: Path | None = None
    image_box: tuple[int, int, int, int] | None = None
    where: Where | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    objects: bool | None = None


def ask(scan_map: Map, question: Question) -> list[QueryResult]:
    """Returns one answer for each word, then for each class, then for the picture. Raises FreeOccError as the map's
    ``query`` methods do."""
    about: dict[str, Any] = {"where": question.where, "objects": question.objects, **question.options}
    results: list[QueryResult] = []
    if question.words:
        results += scan_map.query_words(list(question.words), negative=question.negative, **about)
    if question.classes:
        results += scan_map.query_classes(list(question.classes), **{**about, "objects": bool(question.objects)})
    if question.image is not None:
        results.append(scan_map.query_image(question.image, question.image_box, **about))
    return results
