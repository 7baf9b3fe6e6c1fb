"""What a phrase asks for: without the frame of a prompt ("a photo of a sofa."), and not what it denies ("not red").

Encoders use the words that they know and leave out the others, which must not turn the meaning.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from ..core.errors import FreeOccError

_ARTICLE = r"(?:an?|the|one|this|that|some|my|your|our)"
_QUALITY = (
    r"(?:bad|good|nice|cool|weird|clean|dirty|cropped|close[- ]?up|bright|dark|blurry|blurred|pixelated|small|large|"
    r"big|low[- ]res(?:olution)?|high[- ]res(?:olution)?|jpeg corrupted|black[- ]and[- ]white|colou?r|single|real|rgb|"
    r"realistic|rendered|indoor|detailed)"
)
_IMAGE = r"(?:photo|photograph|picture|pic|image|snapshot|rendering|render|close[- ]?up|itap|view)s?"
_FRAME = re.compile(
    rf"\s*(?:(?:here|there|this|it|that)(?:'s| is| are)\s+)?(?:{_ARTICLE}\s+)?(?:{_QUALITY}[\s,]+)*{_IMAGE}\s+of\s+"
    rf"(?:{_ARTICLE}\s+)?(?=.*\w)",
    re.IGNORECASE,
)
_THERE_IS = re.compile(rf"\s*(?:here|there|where)(?:'s| is| are)\s+(?:{_ARTICLE}\s+)?(?=.*\w)", re.IGNORECASE)
_IN_IMAGE = re.compile(r"\s+(?:in|from) (?:the|this|a|an) (?:scene|photo|picture|image|video)\s*$", re.IGNORECASE)

_DENIALS = (
    "not", "no", "without", "except", "excepting", "excluding", "but", "minus", "neither", "nor", "never", "none",
    "unlike", "lacking", "lacks", "lack", "missing", "absent", "sans", "isnt", "arent",
)  # fmt: skip
_DENIAL = re.compile(
    rf"(?<![\w-])(?:{'|'.join(_DENIALS)}|\w+n['’]t|(?:other|rather) than|apart from|aside from|instead of|free of|"
    r"different from|opposite of|absence of)(?![\w-])|\w+-free(?!\w)",
    re.IGNORECASE,
)


def read_phrase(phrase: str, names: Iterable[str] = ()) -> str:
    """The part of a phrase that says what is asked for: "sofa" of "a photo of a sofa.".

    names: what the scan's things may be called, which is never changed. Raises FreeOccError for a phrase that says what
    is not meant, with the way to say it.
    """
    told = phrase.strip().lower()
    if any(told == name.lower() for name in names):
        return phrase
    if match := _DENIAL.search(phrase):
        raise FreeOccError(
            f"'{phrase}' says what is not meant ('{match[0]}'), which words of a query cannot: ask for what is meant, "
            "and exclude the rest with --not WORD."
        )
    found = phrase
    for frame in (_FRAME, _THERE_IS):
        found = frame.sub("", found, count=1) if frame.match(found) else found
    if found == phrase:
        return phrase
    return _IN_IMAGE.sub("", found.rstrip(" .!")) or found
