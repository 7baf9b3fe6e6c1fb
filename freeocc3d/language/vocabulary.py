"""What people call things in rooms: normal forms, synonyms, and which words include which others."""

from __future__ import annotations

import functools
import re

SYNONYMS: tuple[tuple[str, ...], ...] = (
    ("sofa", "couch", "settee", "loveseat"),
    ("television", "tv", "tvs", "telly", "television set", "tv monitor"),
    ("trash can", "bin", "trash bin", "trashcan", "garbage can", "garbage bin", "waste bin", "wastebasket", "dustbin"),
    ("refrigerator", "fridge"),
    ("wardrobe", "closet", "armoire"),
    ("rug", "carpet", "mat"),
    ("plant", "potted plant", "house plant", "houseplant", "indoor plant"),
    ("lamp", "light", "floor lamp", "table lamp", "desk lamp"),
    ("picture", "painting", "picture frame", "photo frame", "photograph", "photo", "poster", "wall art"),
    ("cup", "mug", "paper cup", "coffee cup"),
    ("bookshelf", "bookcase", "book shelf"),
    ("shelf", "shelf board", "shelves", "rack", "shelving"),
    ("cabinet", "cupboard"),
    ("stove", "cooker", "hob", "oven"),
    ("desk", "writing desk", "office table"),
    ("nightstand", "bedside table", "night table"),
    ("curtain", "drape", "blind"),
    ("computer", "laptop", "notebook computer"),
    ("tablet", "ipad"),
    ("monitor", "computer screen", "display"),
    ("ceiling", "roof"),
    ("floor", "ground", "flooring"),
    ("pillow", "cushion"),
    ("bathtub", "bath", "tub"),
    ("toilet", "wc", "lavatory"),
    ("chair", "seat", "office chair", "armchair", "stool"),
    ("range hood", "cooker hood", "extractor hood"),
    ("air conditioner", "ac", "air conditioning"),
    ("tv cabinet", "tv stand", "tv bench"),
)
"""Words that people use for the same kind of thing indoors."""

INCLUDES: dict[str, tuple[str, ...]] = {
    "table": ("coffee table", "dining table", "side table", "desk", "nightstand", "end table"),
    "door": ("sliding door", "doorframe"),
    "cabinet": ("kitchen cabinet", "tv cabinet", "filing cabinet"),
    "lamp": ("chandelier",),
    "shelf": ("bookshelf", "shoe rack"),
    "furniture": (
        "sofa", "chair", "bed", "wardrobe", "cabinet", "desk", "dining table", "coffee table", "side table",
        "nightstand", "bookshelf", "shelf", "kitchen cabinet", "tv cabinet", "table",
    ),
    "seating": ("sofa", "chair"),
}  # fmt: skip
"""A wider word and the narrower ones that it includes."""

_IRREGULAR = {"tvs": "tv", "shelves": "shelf", "knives": "knife", "people": "person", "men": "man", "women": "woman"}
_UNCHANGED = {"glasses", "glass", "dress", "mattress", "tableware", "utensils", "stairs", "bus", "canvas"}
_ARTICLES = {"a", "an", "the", "my", "your", "this", "that", "some", "any", "all", "of", "every"}


def normal(phrase: str) -> str:
    """Lower case, no articles or punctuation, each word in the singular: "The Coffee-Tables" to "coffee table"."""
    words = [word for word in re.findall(r"[^\W_]+", phrase.lower()) if word not in _ARTICLES]
    return " ".join(_singular(word) for word in words)


def _singular(word: str) -> str:
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if word in _UNCHANGED or len(word) < 4 or not word.endswith("s") or word.endswith(("ss", "us", "is")):
        return word
    if word.endswith("ies"):
        return word[:-3] + "y"
    if word.endswith(("ches", "shes", "xes", "sses")):
        return word[:-2]
    return word[:-1]


@functools.cache
def synonyms(word: str) -> frozenset[str]:
    """The normal forms that mean the same as ``word``, itself included."""
    word = normal(word)
    same = {word}
    for group in SYNONYMS:
        members = {normal(member) for member in group}
        if word in members:
            same |= members
    return frozenset(same)


def matching_names(phrase: str, names: list[str]) -> tuple[list[int], str]:
    """Which of some class names a phrase means, and the part of the phrase that was used.

    The whole phrase is tried first, then its ends ("red office chair", "office chair", "chair"), since the last word
    of an English phrase says what the thing is. A name matches if it is the phrase, a synonym, included in it, or a
    kind of it by its own last word ("table" means "coffee table" and "side table"). No match: ([], "").
    """
    words = normal(phrase).split()[:16]
    known = [normal(name) for name in names]
    for start in range(len(words)):
        part = " ".join(words[start:])
        same = synonyms(part)
        exact = [k for k, name in enumerate(known) if name == part] or [k for k, n in enumerate(known) if n in same]
        included = {normal(inner) for word in same for inner in INCLUDES.get(word, ())}
        kinds = [
            k
            for k, name in enumerate(known)
            if name in included or (len(name.split()) > 1 and name.split()[-1] in same and name not in same)
        ]
        if exact or kinds:
            return sorted({*exact, *kinds}), part
    return [], ""
