"""Finds the voxels and regions of words: what ``freeocc3d query`` and ``Map.query`` do. The module imports little, to
start fast.

A voxel's score for a word is the paper's s(x, c) = f(x)^T t_c, the cosine of its feature and the word's, over the
cosine that the word allows (see ``TextFeatures.attainable``). It may also be relative to other words
(``word_matching``). A voxel matches if its score reaches the threshold and no contrast word (what the voxel could be
instead) is nearer to it: similarities alone do not separate "is" from "is a little like". Voxels that are connected to
these and fit nearly as well also match. Matching voxels that touch form a region.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FreeOccError, MapError
from ..core.types import Occupancy
from ..language import word_matching
from ..language.encoders.color import ColorWords, encode_colors
from ..language.feature_codec import Features, compute_cosines, mask_known
from ..language.phrases import read_phrase
from ..language.synonyms import make_key
from ..occupancy.connected_components import label_components
from ..settings.option_types import Cosine, PositiveInt, PositiveShare, Share
from ..settings.typed_options import TypedOptions, nearest
from .chance import Chance, WordRegions
from .colored_things import choose_colored, read_colors, read_only_colors
from .region_splitting import cut_necks
from .regions import Region, best_regions

if TYPE_CHECKING:
    from ..language.encoders.base import TextEncoder, TextFeatures
    from ..storage.manifest import ChanceRecord

_LONGEST_WORD = 200
_MISSPELT = 0.75  # least ratio of difflib: "yelow" is a misspelling, "canoe" for "camera" is not
_EVEN = 0.5  # a probability
_ROWS = 16384  # voxels per step: float32 copies of all features never exist
_MANY_ROWS = 1 << 18  # voxels per step of compiled code: its threads are worth their start only for many


class Options(TypedOptions, frozen=True):
    """What counts as a match, and which regions the answer holds."""

    scores: Literal["cosine", "softmax", "relevancy"] = "cosine"
    """Kind of score: "cosine" (over the cosine that the word allows), "softmax" (the word's probability against the
    contrast words) or "relevancy" (the least probability against each of some phrases that fit anything, as in LERF).
    """
    threshold: Cosine | None = None
    """Least score of a matching voxel, -1…1; null = 0.5 for probabilities, and for cosines the encoder's own value; for
    an encoder of any words, what random words reach in the map decides."""
    grow: PositiveShare = 0.8
    """A region grows over connected voxels that reach this share of the threshold; 1 = no growth."""
    top_k: PositiveInt = 20
    """Greatest number of regions for a word."""
    min_voxels: PositiveInt = 2
    """Least number of voxels of a region. Smaller regions are left out, unless all are smaller."""
    min_share: Share = 0.001
    """Least volume of a region, as a share of the word's largest region. A region of one to three voxels within half a
    meter of another region is a speck: it needs 50 times this share of that region's volume. 0 = keep all."""
    narrow: Share = 0.5
    """Cut a region into things where, seen from above, it narrows to less than this share of the narrower thing's width
    and to four voxels or less; 0 = regions stay whole."""


@dataclass(frozen=True)
class QueryResult:
    """The answer to one word.

    understood: the part of the word that the encoder understands.  note: one sentence if nothing matched, or if only a
    part of the word was understood; else empty.  regions: best score first.  scores: (V,) score of every occupied
    voxel, 0 where nothing is known.
    """

    word: str
    understood: str
    note: str
    regions: list[Region]
    scores: NDArray[np.float32]

    @property
    def matched(self) -> bool:
        """Whether anything matched."""
        return bool(self.regions)


def query(
    occupancy: Occupancy,
    text_encoder: TextEncoder,
    words: list[str],
    options: Options | None = None,
    contrast: Sequence[str] = (),
    negative: Sequence[str] = (),
    up: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 1.0),
    chance: Callable[[], ChanceRecord] | None = None,
) -> list[QueryResult]:
    """Asks for several words. A word that nothing matches has no regions.

    contrast: words for other things in the scan, added to the encoder's own.  negative: words for what is not meant. A
    voxel whose plain cosine with one of them (f^T t - b(t) of ``query.chance``) is higher than with the word does not
    match, even if the word includes it, as "table" includes a coffee table.  up: (3,) unit vector, map frame.  chance:
    what random words reach in the map, if it is known.
    Raises FreeOccError for an empty, too long or excluded word, one that says what is not meant ("not red"), or a
    negative word that is not understood; MapError if the map's features are not those of the encoder.
    """
    options = options or Options()
    _check_words([*words, *negative])
    names = (*text_encoder.contrast_words(), *contrast)
    asked, denied = ([read_phrase(word, names) for word in some] for some in (words, negative))
    text = text_encoder.encode_words(asked)
    excluded = text_encoder.encode_words(denied)
    for word, part in zip(negative, excluded.understood, strict=True):
        if not part:
            raise FreeOccError(f"'{word}' cannot be excluded{_only_known(word, text_encoder)}")
        if part in text.understood:
            same = "" if word in words else f" '{part}' to this map, which is"
            raise FreeOccError(f"'{word}' is{same} asked for and excluded: leave one out.")
    others = text_encoder.encode_words(list(dict.fromkeys((*names, *denied))))
    features = occupancy.features
    if len(features) and features.shape[1] != text.features.shape[1]:
        raise MapError(
            f"The map's features have {features.shape[1]} dimensions, its encoder's words "
            f"{text.features.shape[1]}: reconstruct the map with this version."
        )
    plain = options.scores == "cosine"
    default = text_encoder.threshold if plain else _EVEN
    threshold = default if options.threshold is None else options.threshold
    if threshold is None:
        measured = Chance(occupancy, text_encoder, chance() if chance else None)
        others = text_encoder.encode_words(list(dict.fromkeys((*names, *measured.record.names, *denied))))
        found = measured.find_regions(text.features, others.features)
        beaten = [_beaten(measured, text, excluded, w) for w in range(len(words))]
        answers = zip(words, text.understood, found, beaten, strict=True)
        return [_answer_by_chance(occupancy, measured, options, up, *answer) for answer in answers]
    expressed = others.features.any(axis=1)
    competes = (compute_cosines(text.features, others.features) < text_encoder.same_word) & expressed
    cosine = every_score = similarity(features, text)
    if not plain:
        pairs = zip(cosine.T, (_some(others, own) for own in competes), strict=True)
        made = [_probability(features, *pair, text_encoder, options.scores) for pair in pairs]
        every_score = np.stack(made, axis=1)
    understood = np.array([bool(part) for part in text.understood])
    candidates = mask_known(features)[:, None] & (every_score >= min(options.grow * threshold, threshold)) & understood
    best = _not_beaten(features, cosine, candidates, others, competes, text_encoder.temperature)
    results = []
    classes = bool(text.meant) and len(occupancy.colors) > 0  # whose things have colors beside
    for w, (word, part) in enumerate(zip(words, text.understood, strict=True)):
        if classes and not part and (colors := read_only_colors(asked[w])):
            results.append(replace(_query_color(occupancy, colors, options, up), word=word))
            continue
        scores = every_score[:, w]
        rows, confidence = best[w]
        if negative and len(rows):
            meant = compute_cosines(features[rows], text.features[w : w + 1])[:, 0]
            allowed = meant >= compute_cosines(features[rows], excluded.features).max(axis=1)
            rows, confidence = rows[allowed], confidence[allowed]
        taken = text.meant[w] if text.meant else ()
        colors = read_colors(asked[w], part) if classes and part else ""
        wanted = options.changed(top_k=max(len(rows), 1)) if colors else options
        regions = find_regions(occupancy, rows, scores[rows], confidence, threshold, wanted, up, word)
        note = _note(word, asked[w], part, taken, text_encoder, scores, threshold, bool(regions))
        result = QueryResult(word, part, note, regions, np.ascontiguousarray(scores))
        results.append(_in_color(occupancy, result, colors, taken, options, up) if colors and regions else result)
    return results


def _answer_by_chance(
    occupancy: Occupancy,
    chance: Chance,
    options: Options,
    up: Sequence[float] | NDArray[np.float64],
    word: str,
    understood: str,
    found: WordRegions,
    excluded: NDArray[np.bool_],
) -> QueryResult:
    """Answers a word by those of its regions that random words hardly reach. The score of a voxel is that of its
    region, 0 outside. excluded: (V,) voxels of what is not meant."""
    allowed = ~excluded[found.rows]
    rows, component, confidence = found.rows[allowed], found.component[allowed], found.confidence[allowed]
    score = chance.score(found.evidence).astype(np.float32)
    scores = np.zeros(len(excluded), np.float32)
    scores[rows] = score[component]
    kept = scores[rows] >= _EVEN
    rows, confidence = rows[kept], confidence[kept]
    component = label_components(occupancy.occupied_voxels()[rows], occupancy.occupied_edges()[rows])
    component = cut_necks(occupancy, rows, component, scores[rows], np.asarray(up), options.narrow)
    least = options.min_voxels, options.min_share
    regions = best_regions(occupancy, rows, component, scores[rows], confidence, *least, options.top_k, word)
    note = "" if regions else _nothing_like(understood, scores, _EVEN)
    return QueryResult(word, understood, note, regions, scores)


def _nothing_like(word: str, scores: NDArray[np.float32], threshold: float) -> str:
    """Returns the sentence about a word that nothing matches."""
    if len(scores) == 0:
        return "The map has no occupied voxels."
    highest = float(scores.max())
    why = f"the best score is {highest:.2f}" + (f", below {threshold:.2f}" if highest < threshold else "")
    return f"Nothing in this map looks like '{word}': {why}."


def _beaten(chance: Chance, text: TextFeatures, excluded: TextFeatures, w: int) -> NDArray[np.bool_]:
    """Returns (V,) whether a voxel is nearer to an excluded word than to word ``w``."""
    features = chance.occupancy.features
    if not len(excluded.understood):
        return np.zeros(len(features), bool)
    meant = chance.compare(features, text.features[w : w + 1])
    return np.asarray((chance.compare(features, excluded.features) > meant).any(axis=1))


def _in_color(
    occupancy: Occupancy,
    result: QueryResult,
    colors: str,
    taken: tuple[str, ...],
    options: Options,
    up: Sequence[float] | NDArray[np.float64],
) -> QueryResult:
    """Leaves of the things of a class those that have colors, or what of them has. taken: the class names."""
    regions, rows, confidence = choose_colored(occupancy, result.regions, colors)
    if not regions:
        found = find_regions(occupancy, rows, result.scores[rows], confidence, -1.0, options, up, result.word)
        regions = [region for region in found if region.voxels >= options.min_voxels]
    part = result.understood if colors in result.understood else f"{colors} {result.understood}"
    note = "" if regions else f"'{result.understood}' is in this map, but not in {colors}."
    if regions and make_key(part) not in (make_key(f"{colors} {name}") for name in taken):
        note = f"'{result.word}' was understood as {', '.join(f'{colors} {name}' for name in taken)}."
    return replace(result, understood=part, note=note, regions=regions[: options.top_k])


def _query_color(
    occupancy: Occupancy, word: str, options: Options, up: Sequence[float] | NDArray[np.float64]
) -> QueryResult:
    """Answers a word that only names colors, from the colors of the voxels."""
    colored = occupancy.replace(features=encode_colors(occupancy.colors).astype(np.float16))
    return query(colored, ColorWords(), [word], options.changed(threshold=None), up=up)[0]


def _check_words(words: list[str]) -> None:
    """Raises FreeOccError for a word that is empty or too long."""
    for word in words:
        if not word.strip():
            raise FreeOccError("A word is empty: give a word or a phrase.")
        if len(word) > _LONGEST_WORD:
            raise FreeOccError(f"'{word[:30]}…' has {len(word)} characters; a query may have up to {_LONGEST_WORD}.")


def find_regions(
    occupancy: Occupancy,
    rows: NDArray[np.int64],
    scores: NDArray[np.float32],
    confidence: NDArray[np.float32],
    threshold: float,
    options: Options,
    up: Sequence[float] | NDArray[np.float64],
    label: str,
) -> list[Region]:
    """Returns the regions of candidates: their connected components that hold a voxel which reaches the threshold, cut
    into things. rows: (n,) rows of occupied voxels.  scores, confidence: (n,)."""
    seeds = scores >= threshold
    if not seeds.any():
        return []
    component = label_components(occupancy.occupied_voxels()[rows], occupancy.occupied_edges()[rows])
    kept = word_matching.grow_regions(seeds, component)
    rows, scores, confidence, component = rows[kept], scores[kept], confidence[kept], component[kept]
    component = cut_necks(occupancy, rows, component, scores, np.asarray(up), options.narrow)
    least = options.min_voxels, options.min_share
    return best_regions(occupancy, rows, component, scores, confidence, *least, options.top_k, label)


def similarity(features: Features, text: TextFeatures) -> NDArray[np.float32]:
    """Returns the (V, W) scores of (V, D) unit features for W words: cosine over attainable cosine, limited to 1."""
    score = compute_cosines(features, text.features)
    if text.attainable is not None:
        score /= text.attainable
    return np.minimum(score, np.float32(1), out=score)


def nearest_word(features: Features, text: TextFeatures) -> NDArray[np.int64]:
    """Returns (V,) which of W words is nearest to each of (V, D) features by plain cosine; -1 where nothing is known.

    Both "table" and "coffee table" fit a coffee table, but the narrower word is nearer to it.
    """
    nearest = np.full(len(features), -1, np.int64)
    for start in range(0, len(features) if len(text.understood) else 0, _ROWS):
        chunk = features[start : start + _ROWS]
        nearest[start : start + _ROWS] = np.where(
            mask_known(chunk), compute_cosines(chunk, text.features).argmax(axis=1), -1
        )
    return nearest


def _some(text: TextFeatures, words: NDArray[np.bool_]) -> TextFeatures:
    """Returns the words of a mask (W,)."""
    understood = tuple(word for word, chosen in zip(text.understood, words, strict=True) if chosen)
    attainable = None if text.attainable is None else text.attainable[words]
    return type(text)(text.features[words], understood, attainable)


def _not_beaten(
    features: Features,
    cosine: NDArray[np.float32],
    candidates: NDArray[np.bool_],
    others: TextFeatures,
    competes: NDArray[np.bool_],
    temperature: float,
) -> list[tuple[NDArray[np.int64], NDArray[np.float32]]]:
    """Returns, for each of W words, the rows of its candidates where no competing word scores higher, and its
    confidences there. cosine: (V, W).  candidates: (V, W).  competes: (W, C), which of C other words compete."""
    asked = np.flatnonzero(candidates.any(axis=1))
    found: list[list[tuple[NDArray[np.int64], NDArray[np.float32]]]] = [[] for _ in competes]
    step = _ROWS if len(asked) < word_matching.MANY else _MANY_ROWS
    for start in range(0, len(asked), step):
        rows = asked[start : start + step]
        against = similarity(features[rows], others)
        confidence = word_matching.compute_confidences(cosine[rows], against, candidates[rows], competes, temperature)
        for w, own in enumerate(found):
            best = np.flatnonzero(confidence[:, w])
            own.append((rows[best], confidence[best, w]))
    nothing = (np.zeros(0, np.int64), np.zeros(0, np.float32))
    return [
        (np.concatenate([rows for rows, _ in (nothing, *own)]), np.concatenate([part for _, part in (nothing, *own)]))
        for own in found
    ]


def _compare_others(
    features: Features, scores: NDArray[np.float32], others: TextFeatures, temperature: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Applies ``word_matching.compare_competitors`` at all voxels. scores: (V,) cosines of a word."""
    largest, odds = np.empty(len(scores), np.float32), np.empty(len(scores), np.float32)
    step = _ROWS if len(scores) < word_matching.MANY else _MANY_ROWS
    for start in range(0, len(scores), step):
        chunk = slice(start, start + step)
        against = similarity(features[chunk], others)
        largest[chunk], odds[chunk] = word_matching.compare_competitors(scores[chunk], against, temperature)
    return largest, odds


def _probability(
    features: Features, scores: NDArray[np.float32], contrast: TextFeatures, text_encoder: TextEncoder, way: str
) -> NDArray[np.float32]:
    """Returns the (V,) softmax or relevancy of a word; 0 where nothing is known. scores: (V,) cosines of the word. If
    the encoder cannot express the phrases that fit anything, its contrast words replace them."""
    others = contrast
    if way == "relevancy":
        canonical = text_encoder.encode_words(list(word_matching.CANONICAL))
        expressed = np.asarray(canonical.features.any(axis=1))
        others = _some(canonical, expressed) if expressed.any() else contrast
    largest, odds = _compare_others(features, scores, others, text_encoder.temperature)
    made = (
        word_matching.compare_with_all(odds)
        if way == "softmax"
        else word_matching.compare_with_best(largest, text_encoder.temperature)
    )
    return np.where(mask_known(features), made, np.float32(0))


def _only_known(word: str, text_encoder: TextEncoder) -> str:
    """Returns the end of a sentence about a word that is not understood: a near word, and what the encoder knows."""
    meant = nearest(word.lower(), text_encoder.contrast_words(), _MISSPELT)
    return f"{meant}: this map knows only {text_encoder.knows}."


def _note(
    word: str,
    phrase: str,
    understood: str,
    meant: tuple[str, ...],
    text_encoder: TextEncoder,
    scores: NDArray[np.float32],
    threshold: float,
    matched: bool,
) -> str:
    if not understood:
        return f"'{word}' is not understood{_only_known(word, text_encoder)}"
    if not matched:
        return _nothing_like(understood, scores, threshold)
    asked = [token for token in re.findall(r"\w+", phrase.lower()) if token not in ("a", "an", "the")]
    partly = len(asked) > len(re.findall(r"\w+", understood))
    named = make_key(understood if partly else phrase) in map(make_key, meant)
    names = "" if named or not meant else f" as {', '.join(meant)}"
    if partly:
        return f"Only '{understood}' of '{word}' was understood{',' * bool(names)}{names}."
    if names:
        return f"'{word}' was understood{names}."
    return ""
