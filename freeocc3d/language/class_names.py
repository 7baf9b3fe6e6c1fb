"""Which of a scan's classes a phrase means: by their names and synonyms, by wider and narrower words, by what things
are for, and despite typing mistakes."""

from __future__ import annotations

import functools
import re

from .encoders import color
from .purposes import find_purpose, find_uses
from .synonyms import INCLUDES, find_narrower, find_synonyms, find_whole, find_wider, make_key, normalize_phrase
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
    r"^(?:.*\s)?(?:pair|pile|stack|set|row|bunch|group|lot|number|couple|piece|kind|type|sort|heap|collection|sheet|roll|bundle)s?\s+of\s+",
    re.I,
)
_COMPLEMENTS = {"of", "in", "for", "from", "where"}
"""Prepositions whose nouns say which thing is meant: "cupboards in the kitchen", "the table where we eat"."""
_EMPTY = {"unit", "set", "system", "device", "machine", "item", "piece", "area"}
"""Last words of phrases that say nothing of the thing: "sofa set", "air conditioning unit"."""
_HOLDERS = {
    "rack", "box", "stand", "cabinet", "cupboard", "closet", "unit", "holder", "shelf", "shelve", "case", "bench",
    "table",
}  # fmt: skip
"""Furniture that is called by what it holds: a "spice rack" may be called a spice box, and is no shoe rack."""
_NAMED_BY_CONTENT = {"rack", "box", "case", "holder", "stand", "bench"}
"""Of these, the ones that are a thing of another kind with another word before them, whatever it is, unless it says how
the thing looks: a wine rack is no shoe rack, a park bench no exercise bench, and a box of pills no spice box."""
_LOOKS = {
    "big", "small", "large", "little", "tiny", "huge", "tall", "high", "low", "long", "short", "wide", "narrow",
    "thin", "thick", "flat", "round", "square", "rectangular", "oval", "old", "new", "modern", "antique",
    "vintage", "dirty", "clean", "empty", "full", "open", "closed", "broken", "nice", "beautiful", "ugly",
    "heavy", "light", "dark", "bright", "pale", "soft", "hard", "wood", "wooden", "metal", "metallic", "steel",
    "iron", "plastic", "glass", "leather", "fabric", "cloth", "wicker", "bamboo", "oak", "pine", "marble",
    "stone", "paper", "cardboard", "wire", "painted", "shiny", "patterned", "striped", "corner", "left", "right",
    "middle", "first", "second", "third", "last", "top", "bottom", "upper", "lower", "other", "only", "single",
    "double", "folding", "foldable", "portable", "adjustable", "freestanding", "storage", "wall", "floor",
    "mounted", "standing", "hanging", "nearest", "closest", "largest", "smallest", "biggest", "highest", "lowest",
    "tallest", "furniture", "home", "house", "room", "indoor", "kitchen", "bedroom", "hall", "hallway", "i", "we",
    "you", "can", "it",
}  # fmt: skip
"""Words that say what a thing looks like or where it is, and not what kind of thing it is."""
_ROOMS = {
    "kitchen",
    "bathroom",
    "bedroom",
    "living",
    "office",
    "hall",
    "hallway",
    "garage",
    "cellar",
    "garden",
    "toilet",
}
"""A bathroom cabinet is no kitchen cabinet."""
_LONGEST_PHRASE = 16
_OTHER_THINGS = {
    "traffic light", "stop light", "water table", "multiplication table", "truck bed", "flower bed", "river bed",
    "sea bed", "cable car", "power plant", "toilet seat", "car seat", "mouse mat", "place mat", "table tennis table",
    "operating table", "bus stop", "hot dog", "chair lift", "phone box", "letter box", "post box", "juke box",
    "street lamp", "street light", "tail light", "head light", "ear phone", "sea floor", "ocean floor",
    "computer game", "board game", "picture book", "shopping cart", "police man", "snow man",
    "periodic table", "time table", "truth table", "league table", "look up table", "price table",
    "geiger counter", "step counter", "word counter", "bean counter", "sleeping bag", "tea bag",
    "air bag", "punching bag", "wheel chair", "electric chair", "pin board", "brake light", "flash light",
    "search light", "day light", "sun light", "moon light", "sky light", "traffic mirror", "wing mirror", "tool bar",
    "browser window", "shop window", "car window", "car door", "trap door", "oven door", "fridge door", "space bar",
    "fire wall", "sea wall", "city wall", "dance floor", "shop floor", "family tree", "bed rock", "oyster bed",
    "nail bed", "lily pad", "launch pad", "prayer book", "check book", "face book", "pill box", "match box", "sand box",
    "music box", "tool box", "juice box", "fuse box", "gear box", "black box", "drop box", "x box", "ballot box",
    "bread box", "piggy bank", "world cup", "egg cup", "suction cup", "eye glass", "fish tank",
    "towel dispenser", "soap dispenser", "paper plane", "sand paper", "wall paper",
    "toilet brush", "heat sink", "motion picture",
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
        rows = known.named(frozenset((parts[0],)))
        return rows, parts[0] if rows else ""
    head, complement = _head_and_complement(phrase)
    for part in parts:
        said = [*head[: len(head) - len(part.split())], *complement]
        rows = known.find(part)
        if said and part in _HOLDERS and part == head[-1]:
            if held := known.find_holders(part, said):
                return held, normalize_phrase(phrase)
            rows = known.without_holders_of_others(rows, part, said)
        if rows:
            narrowed = known.narrow(rows, said)
            return narrowed, part if narrowed == rows else normalize_phrase(phrase)
    return [], ""


class _Names:
    """The names of classes in their normal forms."""

    def __init__(self, names: list[str]):
        self._keys = [make_key(name) for name in names]
        self._kinds = [_tail_keys(name) for name in names]
        self._named = [normalize_phrase(name).split() for name in names]
        self._words = [frozenset(map(make_key, words[:-1])) for words in self._named]

    def find(self, part: str) -> list[int]:
        """Rows of the names that a word means: its own, those of its synonyms, of a wider word, or of a whole."""
        same = find_synonyms(part)
        wider = frozenset(wide for word in same for wide in find_wider(word))
        whole = frozenset(thing for word in same for thing in find_whole(word))
        return self.named(frozenset((part,))) or self.named(same) or self._exactly(wider) or self.named(whole)

    def narrow(self, rows: list[int], said: list[str]) -> list[int]:
        """Of several rows, those whose names hold what else a phrase says of the thing, or that are used for it; all
        rows if there are none."""
        if len(rows) < 2 or not said:
            return rows
        keys, used = _keys_of(said), self._used(said)
        return [row for row in rows if row in used or keys & self._words[row]] or rows

    def _used(self, said: list[str]) -> list[int]:
        """Rows of the things that are used for one of the words."""
        return self.named(frozenset(thing for word in said for thing in find_uses(word)))

    def find_holders(self, part: str, said: list[str]) -> list[int]:
        """Rows of furniture that is named after what a phrase says, or that is used to store it."""
        keys, same = _keys_of(said), {same for word in said for same in find_synonyms(word)}
        rows = [row for row in range(len(self._keys)) if self._holds(row) and keys & self._words[row]]
        stored = [thing for word in same for thing in find_uses(word) if thing in INCLUDES["storage"]]
        return rows or ([] if part in _NAMED_BY_CONTENT else self.named(frozenset(stored)))

    def without_holders_of_others(self, rows: list[int], part: str, said: list[str]) -> list[int]:
        """Rows that are not named after another thing than a phrase with this part says: no shoe rack for a "towel
        rack"."""
        if part in _NAMED_BY_CONTENT and any(map(_is_kind, said)):
            used, same = self._used(said), {make_key(word) for word in find_synonyms(part)}
            same_kind = [row for row in rows if self._keys[row] in same or self._named[row][-1] == part]
            plain = [row for row in same_kind if not any(map(_is_kind, self._named[row][:-1]))]
            rows = [row for row in rows if row in used or row in plain]
        rooms = frozenset() if part in _NAMED_BY_CONTENT else _ROOMS.intersection(said)
        rows = [row for row in rows if not (rooms and _ROOMS.intersection(self._named[row][:-1]) - rooms)]
        if not rooms and not any(_is_thing(word) for word in said):
            return rows
        return [row for row in rows if not (self._holds(row) and any(map(_is_thing, self._named[row][:-1])))]

    def _holds(self, row: int) -> bool:
        return len(self._named[row]) > 1 and self._named[row][-1] in _HOLDERS

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
    head, _ = _head_and_complement(phrase)
    ends = [" ".join(head[start:]) for start in range(len(head))]
    if head and head[-1] in _EMPTY:
        ends += [" ".join(head[start:-1]) for start in range(len(head) - 1)]
    whole = normalize_phrase(" ".join(_tokens(phrase)))
    return list(dict.fromkeys(part for part in (whole, *ends) if part))


def _tokens(phrase: str) -> list[str]:
    return re.findall(r"[^\W_]+", _AMOUNTS.sub("", phrase).lower())[:_LONGEST_PHRASE]


def _head_and_complement(phrase: str) -> tuple[list[str], list[str]]:
    """The words before the first preposition, in their normal forms, and those between it and the next one if they say
    which thing is meant."""
    tokens = _tokens(phrase)
    ends = [at for at, token in enumerate(tokens) if at > 0 and _ends_head(token)]
    cut, after = (*ends, len(tokens), len(tokens))[:2]
    told = tokens[cut + 1 : after] if tokens[cut : cut + 1] and tokens[cut] in _COMPLEMENTS else []
    return normalize_phrase(" ".join(tokens[:cut])).split(), normalize_phrase(" ".join(told)).split()


def _ends_head(token: str) -> bool:
    """Whether what follows only describes the thing: "in the hall", "standing there"."""
    return token in _PREPOSITIONS or token in _PARTICIPLES


def _keys_of(words: list[str]) -> frozenset[str]:
    """Keys of words and their synonyms."""
    return frozenset(make_key(same) for word in words for same in find_synonyms(word))


def _is_kind(word: str) -> bool:
    """Whether a word may say what kind of thing another is: it says neither how things look nor their color."""
    return word not in _LOOKS and not color.parse_colors(word)


@functools.lru_cache(maxsize=4096)
def _is_thing(word: str) -> bool:
    """Whether a word is one for things in rooms, and not a color, material or size."""
    return len(find_synonyms(word)) > 1 or bool(find_wider(word))


@functools.lru_cache(maxsize=4096)
def _tail_keys(name: str) -> frozenset[str]:
    """Keys of the names that a name of several words is a kind of: for "small office chair", "office chair" and
    "chair"."""
    words = normalize_phrase(name).split()
    return frozenset("".join(words[start:]) for start in range(1, len(words)))
