"""What people call things in rooms: normal forms, synonyms, and words that include other words.

The lists are small on purpose. They were written for this project, and contain only what indoor data sets name and
people ask for. A word that is not in them still finds a class with its own name, and by its last word a class that is a
kind of it.
"""

from __future__ import annotations

import functools
import re

SYNONYMS: tuple[tuple[str, ...], ...] = (
    ("sofa", "couch", "settee", "loveseat", "chesterfield", "sectional", "futon"),
    (
        "television", "tv", "telly", "television set", "tv set", "tv screen", "tv monitor", "television screen",
        "flat screen",
    ),
    (
        "trash can", "trash bin", "bin", "rubbish bin", "garbage can", "garbage bin", "waste bin", "dustbin",
        "wastebasket", "waste paper basket", "recycling bin", "trash", "litter bin",
    ),
    ("refrigerator", "fridge", "freezer", "icebox"),
    ("wardrobe", "closet", "armoire"),
    ("rug", "carpet", "mat", "floor mat", "doormat", "bath mat"),
    (
        "plant", "potted plant", "house plant", "indoor plant", "pot plant", "ficus", "indoor tree", "cactus", "fern",
        "palm", "bonsai", "orchid", "succulent", "monstera", "ivy", "rubber tree", "tree",
    ),
    ("lamp", "light", "light fixture"),
    ("floor lamp", "standing lamp", "standard lamp", "torchiere"),
    ("desk lamp", "table lamp", "reading lamp", "bedside lamp", "reading light"),
    ("ceiling light", "ceiling lamp", "pendant lamp", "pendant light"),
    (
        "picture", "painting", "photograph", "photo", "poster", "wall art", "picture frame", "photo frame", "artwork",
        "drawing", "canvas",
    ),
    ("cup", "mug", "teacup"),
    ("bookshelf", "bookcase", "book rack"),
    ("book", "novel", "textbook", "paperback"),
    ("shelf", "shelf board", "shelving", "rack", "shelving unit"),
    ("cabinet", "cupboard", "sideboard", "credenza"),
    ("stove", "cooker", "hob", "cooktop", "oven", "stovetop", "range"),
    ("desk", "writing desk", "office desk", "work desk", "workstation"),
    ("nightstand", "bedside table", "night table", "bedside cabinet", "bedside stand"),
    ("side table", "end table"),
    ("coffee table", "cocktail table"),
    ("dining table", "kitchen table", "dinner table"),
    ("chest of drawers", "dresser", "drawers", "commode", "bureau"),
    ("curtain", "drape", "drapery", "net curtain"),
    ("blind", "window blind", "roller blind", "venetian blind", "roller shade", "window shade", "shutter"),
    ("laptop", "notebook computer", "macbook"),
    ("monitor", "computer screen", "computer monitor", "display"),
    ("computer keyboard", "keyboard"),
    ("computer mouse", "mouse"),
    ("computer", "pc", "desktop computer", "computer tower"),
    ("floor", "ground", "flooring", "parquet"),
    ("wall", "wall panel"),
    ("pillow", "cushion", "throw pillow", "bolster"),
    ("blanket", "throw", "duvet", "comforter", "quilt", "bedspread", "bedcover"),
    ("bathtub", "bath", "tub"),
    ("toilet", "wc", "lavatory", "loo"),
    ("sink", "washbasin", "basin", "hand basin"),
    ("tap", "faucet"),
    ("counter", "countertop", "worktop", "kitchen counter", "work surface"),
    ("seat", "chair"),
    ("armchair", "easy chair", "lounge chair", "recliner", "wing chair", "beanbag", "rocking chair"),
    ("office chair", "desk chair", "swivel chair", "computer chair"),
    ("stool", "bar stool", "footstool", "ottoman", "pouf"),
    ("range hood", "cooker hood", "extractor hood", "kitchen hood", "extractor fan"),
    ("air conditioner", "ac", "air conditioning", "air con"),
    ("fan", "ventilator", "ceiling fan"),
    ("tv cabinet", "tv stand", "tv bench", "tv unit", "media console", "entertainment center"),
    ("tableware", "dishes", "crockery", "dishware"),
    (
        "person", "human", "man", "woman", "child", "boy", "girl", "somebody", "someone", "anybody", "anyone", "adult",
        "kid", "baby", "toddler", "lady", "guy", "colleague", "coworker", "friend", "guest", "visitor", "neighbor",
        "pedestrian", "passer by",
    ),
    ("dumbbell", "barbell", "weights", "kettlebell"),
    ("exercise bench", "weight bench"),
    (
        "kitchen utensils", "utensils", "cutlery", "silverware", "flatware", "cooking utensils", "cooking tools",
        "kitchen tools",
    ),
    ("heater", "radiator", "space heater"),
    ("shoe rack", "shoe shelf", "shoe cabinet"),
    ("shoe", "trainer", "sneaker", "boot", "slipper", "sandal", "footwear", "high heel", "heel", "loafer"),
    ("clothes", "clothing", "garment", "apparel", "laundry", "outfit"),
    ("backpack", "rucksack", "knapsack", "schoolbag"),
    ("bag", "handbag", "purse", "tote", "shopping bag"),
    ("suitcase", "trunk", "baggage"),
    ("basket", "hamper", "laundry basket"),
    ("box", "carton", "cardboard box", "crate"),
    ("bicycle", "bike"),
    ("telephone", "phone", "cell phone", "mobile phone", "mobile", "smartphone", "handset", "iphone", "landline"),
    ("power outlet", "socket", "electrical socket", "plug socket", "wall socket", "electrical outlet", "outlet"),
    ("light switch", "switch", "wall switch"),
    ("speaker", "loudspeaker", "soundbar", "stereo"),
    ("stairs", "staircase", "stairway", "steps"),
    ("door handle", "doorknob"),
    ("door", "doorway", "entrance", "entry", "exit"),
    ("whiteboard", "marker board", "dry erase board", "blackboard", "chalkboard"),
    ("toy", "teddy bear", "teddy", "doll", "stuffed animal", "plush toy", "plushie"),
    ("clock", "wall clock", "alarm clock"),
    ("washing machine", "washer", "clothes washer"),
    ("microwave", "microwave oven"),
    ("vacuum cleaner", "hoover", "vacuum"),
    ("vase", "flower vase"),
    ("candle", "candlestick"),
    ("printer", "copier", "photocopier"),
    ("mirror", "looking glass"),
    ("window", "windowpane"),
    ("towel", "bath towel", "hand towel"),
    ("chandelier",),
    ("spice", "seasoning", "condiment"),
    ("fire extinguisher",),
)  # fmt: skip
"""Words that people use for the same kind of thing indoors."""

INCLUDES: dict[str, tuple[str, ...]] = {
    "chair": ("armchair",),
    "lamp": ("chandelier", "ceiling light", "floor lamp", "desk lamp"),
    "shelf": ("bookshelf",),
    "tableware": ("cup", "plate", "bowl", "glass", "wine glass", "saucer", "teapot"),
    "kitchen utensil": ("knife", "fork", "spoon", "spatula", "ladle"),
    "clothes": ("jacket", "coat", "shirt", "sweater", "dress", "trousers", "pants", "jeans", "hat",
                "scarf", "skirt", "hoodie", "blouse", "suit", "pajamas", "sock", "glove", "cap"),
    "computer": ("laptop", "tablet", "monitor"),
    "electronic": (
        "television", "laptop", "monitor", "computer", "speaker", "printer", "telephone", "computer keyboard",
        "computer mouse", "microwave",
    ),
    "gym equipment": ("dumbbell", "exercise bench"),
    "storage": (
        "cabinet", "shelf", "bookshelf", "wardrobe", "chest of drawers", "box", "basket", "shoe rack", "tv cabinet",
    ),
    "lighting": ("lamp", "chandelier"),
    "light source": ("lamp", "chandelier"),
    "ceiling light": ("chandelier",),
    "container": ("box", "basket", "bottle", "bag", "vase", "trash can"),
    "luggage": ("suitcase", "backpack", "bag"),
    "white good": ("refrigerator", "dishwasher", "washing machine", "stove"),
    "sanitary": ("toilet", "sink", "bathtub", "shower"),
    "decoration": ("picture", "vase", "candle", "plant", "rug"),
    "textile": ("towel", "curtain", "blanket", "rug", "pillow"),
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

PARTS: dict[str, tuple[str, ...]] = {
    "bed": ("mattress", "headboard", "bed frame"),
    "window": ("pane", "window frame", "window sill"),
    "floor": ("floorboard", "tile", "floor tile", "laminate"),
    "door": ("door frame",),
    "door handle": ("knob", "handle", "latch"),
    "lamp": ("lampshade", "light bulb", "bulb"),
    "chair": ("stool", "highchair"),
    "camera": ("webcam", "camcorder", "action camera"),
    "tablet": ("ipad", "e reader", "ereader"),
    "bag": ("backpack",),
}  # fmt: skip
"""A thing -> its parts, and special kinds of it, which mean the thing where the scan's classes have none of their own.
The thing does not mean them: who asks for chairs does not ask for stools."""

_IRREGULAR = {
    "shelves": "shelf", "bookshelves": "bookshelf", "knives": "knife", "people": "person", "men": "man",
    "women": "woman", "children": "child", "clothes": "clothes", "scissors": "scissors", "stairs": "stairs",
}  # fmt: skip
_ARTICLES = {"a", "an", "the", "my", "your", "our", "this", "that", "these", "those", "some", "any", "all", "every"}


@functools.lru_cache(maxsize=4096)
def normalize_phrase(phrase: str) -> str:
    """Lower case, no articles or punctuation, each word in the singular: "The Coffee-Tables" to "coffee table"."""
    words = re.findall(r"[^\W_]+", phrase.lower())
    return " ".join(make_singular(word) for word in words if word not in _ARTICLES)


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


@functools.cache
def find_whole(word: str) -> frozenset[str]:
    """The normal forms of the things of which ``word`` is a part or a special kind."""
    key = make_key(word)
    return frozenset(normalize_phrase(whole) for whole in PARTS if key in {make_key(part) for part in PARTS[whole]})


def make_key(name: str) -> str:
    """A key that is equal for "night stand", "Nightstand" and "nightstands"."""
    return normalize_phrase(name).replace(" ", "")


def make_singular(word: str) -> str:
    """ "shelves" to "shelf", "boxes" to "box"."""
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if len(word) < 3 or not word.endswith("s") or word.endswith(("ss", "us", "is")):
        return word
    if word.endswith("ies"):
        return word[:-3] + "y"
    if word.endswith(("ches", "shes", "xes", "sses")):
        return word[:-2]
    return word[:-1]
