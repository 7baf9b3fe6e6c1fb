"""What people call things in rooms: normal forms, synonyms, and words that include other words.

The lists are small on purpose. They were written for this project, and contain only what indoor data sets name and
people ask for. A word that is not in them still finds a class with its own name, and by its last word a class that is a
kind of it.
"""

from __future__ import annotations

import functools
import re

SYNONYMS: tuple[tuple[str, ...], ...] = (
    ("sofa", "couch", "settee", "loveseat"),
    ("television", "tv", "telly", "television set", "tv screen", "tv monitor", "television screen"),
    (
        "trash can", "trash bin", "bin", "rubbish bin", "garbage can", "garbage bin", "waste bin", "dustbin",
        "wastebasket", "waste paper basket",
    ),
    ("refrigerator", "fridge", "freezer"),
    ("wardrobe", "closet", "armoire"),
    ("rug", "carpet", "mat", "floor mat"),
    ("plant", "potted plant", "house plant", "indoor plant", "pot plant"),
    ("lamp", "light"),
    ("ceiling light", "ceiling lamp"),
    ("picture", "painting", "photograph", "photo", "poster", "wall art", "picture frame", "photo frame"),
    ("cup", "mug"),
    ("bookshelf", "bookcase"),
    ("shelf", "shelf board", "shelving", "rack"),
    ("cabinet", "cupboard"),
    ("stove", "cooker", "hob", "cooktop", "oven"),
    ("desk", "writing desk", "office desk", "work desk"),
    ("nightstand", "bedside table", "night table", "bedside cabinet"),
    ("side table", "end table"),
    ("dining table", "kitchen table", "dinner table"),
    ("chest of drawers", "dresser", "drawers", "commode", "bureau"),
    ("curtain", "drape", "drapery"),
    ("blind", "window blind", "roller blind", "venetian blind"),
    ("laptop", "notebook computer"),
    ("monitor", "computer screen", "computer monitor", "display"),
    ("floor", "ground", "flooring"),
    ("wall", "wall panel"),
    ("pillow", "cushion"),
    ("blanket", "throw", "duvet", "comforter", "quilt", "bedspread"),
    ("bathtub", "bath", "tub"),
    ("toilet", "wc", "lavatory"),
    ("sink", "washbasin", "basin"),
    ("tap", "faucet"),
    ("counter", "countertop", "worktop", "kitchen counter"),
    ("seat", "chair"),
    ("armchair", "easy chair", "lounge chair"),
    ("office chair", "desk chair", "swivel chair"),
    ("stool", "bar stool"),
    ("range hood", "cooker hood", "extractor hood", "kitchen hood"),
    ("air conditioner", "ac", "air conditioning", "air con"),
    ("tv cabinet", "tv stand", "tv bench", "tv unit", "media console"),
    ("tableware", "dishes", "crockery"),
    ("person", "human", "man", "woman"),
    ("dumbbell", "barbell", "weights"),
    ("exercise bench", "weight bench"),
    ("kitchen utensils", "utensils", "cutlery"),
    ("heater", "radiator"),
    ("shoe rack", "shoe shelf", "shoe cabinet"),
)  # fmt: skip
"""Words that people use for the same kind of thing indoors."""

INCLUDES: dict[str, tuple[str, ...]] = {
    "chair": ("armchair", "stool"),
    "lamp": ("chandelier", "ceiling light"),
    "shelf": ("bookshelf",),
    "tableware": ("cup", "plate", "bowl", "glass", "saucer", "teapot"),
    "computer": ("laptop", "tablet", "monitor"),
    "screen": ("monitor", "television", "laptop", "tablet"),
    "bedding": ("pillow", "blanket", "sheet"),
    "seating": ("chair", "sofa", "armchair", "stool", "bench"),
    "appliance": ("refrigerator", "stove", "range hood", "microwave", "dishwasher", "washing machine"),
    "furniture": (
        "sofa", "chair", "armchair", "stool", "bed", "table", "desk", "nightstand", "cabinet", "wardrobe", "bookshelf",
        "shelf", "chest of drawers",
    ),
}  # fmt: skip
"""A wider word -> narrower words that it includes, in addition to those that end with it ("dining table" is a
table)."""

_IRREGULAR = {
    "shelves": "shelf", "bookshelves": "bookshelf", "knives": "knife", "people": "person", "men": "man",
    "women": "woman", "children": "child",
}  # fmt: skip
_ARTICLES = {"a", "an", "the", "my", "your", "our", "this", "that", "these", "those", "some", "any", "all", "every"}
_PREPOSITIONS = {
    "of", "on", "in", "at", "by", "with", "without", "near", "under", "above", "behind", "beside", "between", "next",
    "from", "for", "to", "against", "that", "which",
}  # fmt: skip
_LONGEST_PHRASE = 16


@functools.lru_cache(maxsize=4096)
def normalize_phrase(phrase: str) -> str:
    """Lower case, no articles or punctuation, each word in the singular: "The Coffee-Tables" to "coffee table"."""
    words = re.findall(r"[^\W_]+", phrase.lower())
    return " ".join(_singular(word) for word in words if word not in _ARTICLES)


def match_names(phrase: str, names: list[str]) -> tuple[list[int], str]:
    """Returns the class names that a phrase means, and the part of the phrase that was used; no match: ([], "").

    The whole phrase is tried first, then the ends of the part before a preposition ("red chair by the window": "red
    chair", "chair"), since the last word of an English noun phrase says what the thing is. A part means the names that
    are equal to it or a kind of it ("table": "coffee table" and "side table"). If there are none, it means those of its
    synonyms; if there are none either, the names of a wider word that includes it ("mug": "tableware").
    """
    known = [make_key(name) for name in names]
    kinds = [_tail_keys(name) for name in names]
    parts = split_phrase(phrase)
    for part in parts:
        for words in (frozenset((part,)), find_synonyms(part)):
            if found := _named(words, known, kinds):
                return found, part
    for part in parts:
        if found := _exactly({wide for word in find_synonyms(part) for wide in find_wider(word)}, known):
            return found, part
    return [], ""


@functools.cache
def find_synonyms(word: str) -> frozenset[str]:
    """The normal forms with the same meaning as ``word``, including ``word``."""
    same = {normalize_phrase(word)}
    for group in SYNONYMS:
        if make_key(word) in {make_key(member) for member in group}:
            same |= {normalize_phrase(member) for member in group}
    return frozenset(same)


@functools.cache
def find_narrower(word: str) -> frozenset[str]:
    """The normal forms of the words that ``word`` includes, directly or through others, with their synonyms."""
    found: set[str] = set()
    for inner in INCLUDES.get(normalize_phrase(word), ()):
        found |= find_synonyms(inner) | find_narrower(inner)
    return frozenset(found)


@functools.cache
def find_wider(word: str) -> frozenset[str]:
    """The normal forms of the words that include ``word``."""
    key = make_key(word)
    return frozenset(
        normalize_phrase(wide) for wide in INCLUDES if key in {make_key(inner) for inner in INCLUDES[wide]}
    )


def split_phrase(phrase: str) -> list[str]:
    """Normal forms to look up, most specific first."""
    tokens = re.findall(r"[^\W_]+", phrase.lower())[:_LONGEST_PHRASE]
    cut = next((at for at, token in enumerate(tokens) if at > 0 and token in _PREPOSITIONS), len(tokens))
    head = normalize_phrase(" ".join(tokens[:cut])).split()
    ends = [" ".join(head[start:]) for start in range(len(head))]
    return list(dict.fromkeys(part for part in (normalize_phrase(" ".join(tokens)), *ends) if part))


def _named(words: frozenset[str], known: list[str], kinds: list[frozenset[str]]) -> list[int]:
    """Rows of the names that are in ``words``, or a kind of one of them."""
    keys = {make_key(word) for word in words}
    keys |= {make_key(name) for word in words for name in find_narrower(word)}
    return [row for row, name in enumerate(known) if name in keys or kinds[row] & keys]


def _exactly(words: set[str], known: list[str]) -> list[int]:
    keys = {make_key(word) for word in words}
    return [row for row, name in enumerate(known) if name in keys]


def make_key(name: str) -> str:
    """A key that is equal for "night stand", "Nightstand" and "nightstands"."""
    return normalize_phrase(name).replace(" ", "")


@functools.lru_cache(maxsize=4096)
def _tail_keys(name: str) -> frozenset[str]:
    """Keys of the names that a name of several words is a kind of: for "small office chair", "office chair" and
    "chair"."""
    words = normalize_phrase(name).split()
    return frozenset("".join(words[start:]) for start in range(1, len(words)))


def _singular(word: str) -> str:
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if len(word) < 3 or not word.endswith("s") or word.endswith(("ss", "us", "is")):
        return word
    if word.endswith("ies"):
        return word[:-3] + "y"
    if word.endswith(("ches", "shes", "xes", "sses")):
        return word[:-2]
    return word[:-1]
