"""Words to compare a word with: what they score in a map is what chance scores there. No scene holds many of them."""

from __future__ import annotations

from collections.abc import Sequence

from .synonyms import SYNONYMS
from .word_matching import CANONICAL

HOUSE_WORDS = (
    "armchair", "ashtray", "alarm clock", "apron", "bathrobe", "bathtub", "bench", "birdcage", "blender",
    "bookcase", "bottle", "broom", "bucket", "calculator", "calendar", "candle", "clothes hanger", "coffee maker",
    "comb", "crib", "cup", "cutting board", "dishwasher", "doorknob", "drawer", "dress", "dustpan", "fan",
    "faucet", "fireplace", "flowerpot", "fork", "frying pan", "glove", "guitar", "hairdryer", "hammer", "hammock",
    "hat", "headphones", "ironing board", "jar", "jewelry", "kettle", "keyboard", "knife", "ladder", "lampshade",
    "laptop", "lock", "magazine", "mattress", "microwave oven", "mirror", "mop", "mug", "napkin", "necktie",
    "newspaper", "oven", "perfume", "piano", "pitcher", "plate", "power outlet", "printer", "quilt", "radiator",
    "radio", "razor", "sandal", "scale", "scissors", "sewing machine", "shampoo", "shirt", "shoe",
    "shower curtain", "soap", "speaker", "spoon", "stapler", "stool", "stove", "suitcase", "teapot", "telephone",
    "toaster", "toilet", "toothbrush", "towel", "toy", "tray", "typewriter", "umbrella", "urinal",
    "vacuum cleaner", "wallet", "washing machine", "watch",
)  # fmt: skip
"""Things of houses."""

OTHER_WORDS = (
    "airplane", "ambulance", "apple", "avocado", "banana", "baseball bat", "basketball", "beach ball", "bear",
    "bicycle", "bird", "boat", "bread", "broccoli", "bus", "butterfly", "cake", "camel", "canoe", "carrot", "cat",
    "cherry", "chicken", "coconut", "computer mouse", "cow", "crab", "crocodile", "crown", "deer", "dog",
    "dolphin", "donut", "dragonfly", "drum", "duck", "eagle", "egg", "elephant", "fire hydrant", "fish", "flag",
    "flute", "football", "frog", "garlic", "giraffe", "goat", "golf club", "grape", "hamburger", "helicopter",
    "helmet", "horse", "ice cream", "kite", "lemon", "lion", "lizard", "lobster", "microscope", "monkey",
    "motorcycle", "mushroom", "onion", "orange", "ostrich", "owl", "parachute", "parking meter", "peach", "pear",
    "penguin", "pepper", "pig", "pigeon", "pineapple", "pizza", "pumpkin", "rabbit", "rifle", "rose", "sandwich",
    "saxophone", "seashell", "sheep", "skateboard", "snake", "spider", "squirrel", "starfish", "strawberry",
    "street sign", "surfboard", "tennis racket", "tomato", "tractor", "traffic light", "train", "trumpet",
)  # fmt: skip
"""Other things that have a name and a look."""

RANDOM_WORDS = (*HOUSE_WORDS, *OTHER_WORDS)


def list_house_names(contrast: Sequence[str]) -> list[str]:
    """Returns names for what is in a room: contrast words that name things, one of each group of synonyms, and
    ``HOUSE_WORDS``."""
    named = (word for word in contrast if word not in CANONICAL)
    return list(dict.fromkeys((*named, *(same[0] for same in SYNONYMS), *HOUSE_WORDS)))
