"""What things in rooms are for: "something to sit on" means seats, "where do I throw this away" the trash can.

The table was written for this project. A phrase is read so only if it begins as such phrases do.
"""

from __future__ import annotations

import functools
import re

from .synonyms import find_synonyms, make_singular

_ASKS = re.compile(
    r"\s*(?:(?:find|show|give|bring|get)\s+(?:me\s+)?|i\s+(?:need|want|am looking for)\s+|is there\s+)?"
    r"(?:(?:some|any)(?:thing|where|place)|(?:an?|the|some|any)?\s*(?:\w+\s+)?(?:places?|things?|spots?|objects?|devices?|"
    r"appliances?|tools?|items?|machines?|gadgets?|containers?|surfaces?|pieces? of furniture|furniture|stuff|ways?)\b"
    r"(?=\s+(?:to|for|that|which|where|i|you|we|one|out|in|on|with|of)\b)|what|where|which|how|to)\b",
    re.IGNORECASE,
)
_LEAST_STEM = 3
_PAST = {
    "kept": "keep", "hung": "hang", "thrown": "throw", "threw": "throw", "slept": "sleep", "sat": "sit", "eaten": "eat",
    "drunk": "drink", "written": "write", "worn": "wear", "hidden": "hide",
}  # fmt: skip

PURPOSES: dict[tuple[str, ...], tuple[str, ...]] = {
    ("sit", "sit down", "seat", "rest leg"): ("chair", "sofa", "armchair", "stool", "bench"),
    ("sleep", "lie down", "lie", "nap", "lay down", "rest"): ("bed",),
    ("head", "rest head"): ("pillow",),
    ("cover", "warm bed", "keep warm bed", "wrap"): ("blanket",),
    ("wash hand", "wash face", "rinse", "brush tooth", "water", "wash"): ("sink", "tap"),
    ("drink", "tea", "coffee"): ("cup", "glass"),
    ("eat", "dinner", "lunch", "breakfast", "meal", "dine"): ("dining table",),
    ("put drink", "put cup", "put coffee", "put down"): ("coffee table", "side table", "table"),
    ("read",): ("book",),
    ("write", "draw", "note"): ("whiteboard", "desk"),
    ("work", "study", "homework", "write letter"): ("desk",),
    ("throw", "throw away", "trash", "garbage", "rubbish", "waste", "litter", "dispose", "recycle",
     "drop", "discard", "toss", "chuck", "get rid", "bin"): ("trash can",),
    ("clothes", "clothing", "shirt", "dress", "put clothes", "keep clothes", "store clothes"): (
        "wardrobe", "chest of drawers",
    ),
    ("hang coat", "coat", "jacket", "hang jacket", "hang clothes", "hang"): ("wardrobe", "coat rack", "hook"),
    ("cook", "fry", "boil", "bake", "roast", "cooking", "heat soup"): ("stove",),
    ("leftover", "reheat", "heat food", "heat leftover", "warm food", "heat meal", "popcorn"): ("microwave",),
    ("cold", "keep fresh", "cool milk", "cool drink", "cool food", "milk", "beer", "keep cold", "keep cool", "ice"): (
        "refrigerator",
    ),
    ("cool", "cool room", "cool air", "cool down", "hot day"): ("air conditioner", "fan"),
    ("warm", "warm room", "heat", "heat room", "warm up", "keep warm"): ("heater", "fireplace"),
    ("tell time", "time"): ("clock",),
    ("film", "movie", "watch", "show", "watch film", "watch tv"): ("television",),
    ("look myself", "see myself", "reflection", "shave", "makeup", "look face", "check hair", "fix hair", "comb hair",
     "check outfit", "see face"): ("mirror",),
    ("dry", "dry hand", "dry off", "dry myself", "dry hair"): ("towel",),
    ("charge", "plug", "electricity", "charge phone", "plug in"): ("power outlet",),
    ("fire", "extinguish", "put out fire", "put out"): ("fire extinguisher",),
    ("out", "way out", "exit", "leave", "leave room", "enter", "get out", "go out", "walk through"): ("door",),
    ("open door", "close door"): ("door handle",),
    ("sun", "sunlight", "block sun", "keep sun out", "dark", "privacy", "shade", "keep light out", "block light"): (
        "blind", "curtain",
    ),
    ("laundry", "wash clothes", "wash laundry", "clean clothes", "clean laundry"): ("washing machine",),
    ("bath", "take bath", "bathe", "soak"): ("bathtub",),
    ("shower", "take shower"): ("shower",),
    ("carry", "pack", "carry thing", "travel"): ("bag", "backpack", "suitcase"),
    ("flower", "put flower", "bouquet"): ("vase",),
    ("light", "give light", "bright", "illuminate", "see dark", "make light"): ("lamp",),
    ("turn light", "switch light", "turn on light", "turn off light"): ("light switch",),
    ("climb", "upstair", "go up", "get up", "upper floor", "go upstairs", "go down"): ("stairs", "ladder"),
    ("type", "typing"): ("computer keyboard",),
    ("rain", "dry rain", "keep dry", "keep dry rain"): ("umbrella",),
    ("shoe", "put shoe", "keep shoe"): ("shoe rack",),
    ("walk", "wear foot"): ("shoe",),
    ("look outside", "look out", "see outside", "fresh air", "daylight", "let air in", "let light in"): ("window",),
    ("music", "listen", "play music", "listen music", "sound"): ("speaker",),
    ("exercise", "get fit", "work out", "workout", "lift", "train", "muscle"): ("exercise bench", "dumbbell"),
    ("print", "print page", "copy", "make copy", "scan"): ("printer",),
    ("call", "phone", "ring"): ("telephone",),
    ("sweep", "vacuum", "clean floor", "dust"): ("broom", "vacuum cleaner"),
    ("wash dish", "clean dish", "wash plate", "dirty dish"): ("dishwasher", "sink"),
    ("put book", "keep book", "store book", "store"): ("bookshelf", "shelf", "cabinet"),
    ("cut", "slice"): ("knife", "scissors"),
    ("pee", "relieve myself", "toilet"): ("toilet",),
    ("ride", "cycle", "pedal"): ("bicycle",),
    ("play", "child play", "kid play"): ("toy",),
    ("compute", "browse", "internet", "email"): ("laptop", "computer"),
    ("smoke", "suck", "fume", "cook smell", "extract"): ("range hood",),
}  # fmt: skip
"""What is done -> the things that it is done with. Words are in the form of ``_stem``; all of an entry's words must
occur, and the entries with the most words win, of these the ones that occur first: the verb of a phrase."""


def find_purpose(phrase: str) -> tuple[str, ...]:
    """The words for the things that a phrase describes by their purpose; none if it does not."""
    if not (match := _ASKS.match(phrase)):
        return ()
    told = re.findall(r"[^\W_]+", phrase[match.end() :].lower())
    place: dict[str, int] = {}
    for at, word in enumerate((*(["way"] if "way" in match[0].lower() else []), *told)):
        for form in (*_stems(word), *find_synonyms(word)):
            place.setdefault(form, at)
    best, found = (0, 0), dict[str, None]()
    for done, things in PURPOSES.items():
        for words in (entry.split() for entry in done):
            if all(word in place for word in words):
                fit = len(words), -min(place[word] for word in words)
                if fit >= best:
                    found = dict.fromkeys((*(found if fit == best else ()), *things))
                    best = fit
    return tuple(found)


@functools.cache
def find_uses(word: str) -> tuple[str, ...]:
    """The words for the things that are used for one word alone: "dining table" for "dinner"."""
    return tuple(thing for done, things in PURPOSES.items() if _stem(word) in done for thing in things)


def _stems(word: str) -> tuple[str, ...]:
    """What a word may be a form of: "stored" of "store", "kept" of "keep"."""
    if word.endswith("ed") and len(word) >= _LEAST_STEM + 2:
        bare = word.removesuffix("ed")
        return bare, word.removesuffix("d"), bare[:-1]
    return (_PAST.get(word) or _stem(word),)


def _stem(word: str) -> str:
    """A word without the ending of a plural or of a verb: "hands" to "hand", "sitting" to "sit"."""
    if word.endswith("ing") and len(word) >= _LEAST_STEM + 3:
        word = word.removesuffix("ing")
        return word[:-1] if len(word) > _LEAST_STEM and word[-1] == word[-2] else word
    return make_singular(word)
