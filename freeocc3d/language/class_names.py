"""Which of a scan's classes a phrase means: by their names and synonyms, by wider and narrower words, by what things
are for, and despite typing mistakes."""

from __future__ import annotations

import functools
import re

from .purposes import find_purpose
from .synonyms import find_narrower, find_synonyms, find_wider, make_key, normalize_phrase
from .typing_mistakes import correct_words

_PREPOSITIONS = {
    "of", "on", "in", "at", "by", "with", "without", "near", "under", "above", "behind", "beside", "between", "next",
    "from", "for", "to", "against", "that", "which",
}  # fmt: skip
_PARTICIPLES = {
    "standing", "sitting", "lying", "hanging", "leaning", "facing", "placed", "mounted", "attached", "fixed", "left",
    "made", "full", "filled", "covered", "belonging", "called", "used", "over", "inside", "beneath", "below", "along",
    "around", "opposite", "across", "upon", "where", "who", "is", "are", "has",
}  # fmt: skip
_AMOUNTS = re.compile(
    r"^(?:.*\s)?(?:pair|pile|stack|set|row|bunch|group|lot|number|couple|piece|kind|type|sort|heap|collection)s?\s+of\s+",
    re.I,
)
_LONGEST_PHRASE = 16
_OTHER_THINGS = {
    "traffic light", "stop light", "water table", "multiplication table", "truck bed", "flower bed", "river bed",
    "sea bed", "cable car", "power plant", "toilet seat", "car seat", "mouse mat", "place mat", "table tennis table",
    "operating table", "bus stop", "hot dog", "chair lift", "phone box", "letter box", "post box", "juke box",
    "street lamp", "street light", "tail light", "head light", "ear phone", "sea floor", "ocean floor",
    "computer game", "board game", "picture book", "shopping cart", "police man", "snow man",
}  # fmt: skip
"""Words whose last part is the name of a thing that they are not a kind of."""


def match_names(phrase: str, names: list[str]) -> tuple[list[int], str]:
    """``match_exactly``, after words that are no English became the nearest ones that would be understood."""
    return match_exactly(correct_words(phrase, tuple(names)), names)


def match_exactly(phrase: str, names: list[str]) -> tuple[list[int], str]:
    """Returns the class names that a phrase means, and what was understood; no match: ([], "").

    A phrase that says what a thing is for
    means such things. Otherwise the whole phrase is tried first, then the ends of
    the part before a preposition ("red chair by the window": "red chair", "chair"), since the last word of an English
    noun phrase says what the thing is. A part means the names that are equal to it or a kind of it ("table": "coffee
    table" and "side table"). If there are none, it means those of its synonyms; if there are none either, the names of
    a wider word that includes it ("mug": "tableware").
    """
    known = _Names(names)
    if things := find_purpose(phrase):
        found = [known.find(thing) for thing in things]
        if any(found):
            return sorted({row for rows in found for row in rows}), normalize_phrase(phrase)
    parts = split_phrase(phrase)
    if any(make_key(other) == make_key(part) for part in parts for other in _OTHER_THINGS):
        return known.named(frozenset((parts[0],))), parts[0]
    for part in parts:
        if rows := known.find(part):
            return rows, part
    return [], ""


class _Names:
    """The names of classes in their normal forms."""

    def __init__(self, names: list[str]):
        self._keys = [make_key(name) for name in names]
        self._kinds = [_tail_keys(name) for name in names]

    def find(self, part: str) -> list[int]:
        """Rows of the names that a word means: its own, those of its synonyms, or of a wider word."""
        same = find_synonyms(part)
        wider = frozenset(wide for word in same for wide in find_wider(word))
        return self.named(frozenset((part,))) or self.named(same) or self._exactly(wider)

    def named(self, words: frozenset[str]) -> list[int]:
        """Rows of the names that are in ``words``, or a kind of one of them."""
        keys = {make_key(word) for word in words}
        keys |= {make_key(name) for word in words for name in find_narrower(word)}
        return [row for row, name in enumerate(self._keys) if name in keys or self._kinds[row] & keys]

    def _exactly(self, words: frozenset[str]) -> list[int]:
        keys = {make_key(word) for word in words}
        return [row for row, name in enumerate(self._keys) if name in keys]


def split_phrase(phrase: str) -> list[str]:
    """Normal forms to look up, most specific first."""
    tokens = re.findall(r"[^\W_]+", _AMOUNTS.sub("", phrase).lower())[:_LONGEST_PHRASE]
    cut = next((at for at, token in enumerate(tokens) if at > 0 and _ends_head(token)), len(tokens))
    head = normalize_phrase(" ".join(tokens[:cut])).split()
    ends = [" ".join(head[start:]) for start in range(len(head))]
    return list(dict.fromkeys(part for part in (normalize_phrase(" ".join(tokens)), *ends) if part))


def _ends_head(token: str) -> bool:
    """Whether what follows only describes the thing: "in the hall", "standing there"."""
    return token in _PREPOSITIONS or token in _PARTICIPLES


@functools.lru_cache(maxsize=4096)
def _tail_keys(name: str) -> frozenset[str]:
    """Keys of the names that a name of several words is a kind of: for "small office chair", "office chair" and
    "chair"."""
    words = normalize_phrase(name).split()
    return frozenset("".join(words[start:]) for start in range(1, len(words)))
