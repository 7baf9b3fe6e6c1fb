"""Corrects words that are no English to the nearest ones that a map would understand: "refridgerator".

A word that exists is never changed: "cable" does not become "table". The dictionary comes with symspellpy, which also
finds the nearest words. Source: W. Garbe, SymSpell (symmetric delete spelling correction), 2012.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import TYPE_CHECKING

from .synonyms import INCLUDES, SYNONYMS, make_singular, normalize_phrase

if TYPE_CHECKING:
    from symspellpy import SymSpell

_WORD = re.compile(r"[^\W\d_]+")
_SHORT, _LONG = 4, 7
"""Letters from which one mistake is corrected, and two."""


def correct_words(phrase: str, names: tuple[str, ...]) -> str:
    """The phrase with each word that does not exist replaced by the nearest word of synonyms and names, if one is
    near."""
    return _WORD.sub(lambda match: _correct(match[0], names), phrase)


def _correct(word: str, names: tuple[str, ...]) -> str:
    mistakes = (len(word) >= _SHORT) + (len(word) >= _LONG)
    known = _known_words(names)
    if not mistakes or normalize_phrase(word) in known or word.lower() in _english():
        return word
    from symspellpy import Verbosity

    found = _index(known).lookup(make_singular(word.lower()), Verbosity.TOP, max_edit_distance=mistakes)
    return found[0].term if found else word


@functools.lru_cache(maxsize=8)
def _index(known: frozenset[str]) -> SymSpell:
    from symspellpy import SymSpell

    index = SymSpell(max_dictionary_edit_distance=2)
    for word in sorted(known):
        index.create_dictionary_entry(word, 1)
    return index


@functools.lru_cache(maxsize=8)
def _known_words(names: tuple[str, ...]) -> frozenset[str]:
    """The words of all synonyms and of names."""
    listed = (*names, *INCLUDES, *(word for group in (*SYNONYMS, *INCLUDES.values()) for word in group))
    return frozenset(word for name in listed for word in normalize_phrase(name).split())


@functools.cache
def _english() -> frozenset[str]:
    """82,765 words, with British spelling."""
    import symspellpy

    lines = (
        (Path(symspellpy.__file__).parent / "frequency_dictionary_en_82_765.txt").read_text("utf-8-sig").splitlines()
    )
    return frozenset(line.split()[0] for line in lines if line)
