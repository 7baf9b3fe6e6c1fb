"""Names of the things in a scene from a vision-language model; off unless an endpoint is given.

Paper, supplement, "Open-vocabulary semantic cue generation": a VLM (Qwen3-VL there) names the object categories that it
sees in each frame; aggregated over time, they are the scene's vocabulary. Here the questions are about a limited number
of keyframes, evenly spread. The names are normalized and counted. For an encoder of open vocabulary, a queried word
must then match better than all these names (``query``), and pictures by class use them. If a model does not
answer, or answers without names, there is a warning and there are fewer names; the map is still made.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.atomic_files import replace_text
from ..core.checksums import seal, unseal
from ..core.errors import ConfigError
from ..core.regular_files import TEXT_BYTES, read_bytes
from ..core.typed_documents import as_type, parse_json
from ..core.types import Frame
from ..core.warnings import Notice
from ..settings.stages import VocabularyOptions as Options
from .synonyms import normalize_phrase
from .vision_server import ServerError, VisionServer, resolve_address, shorten_to_line

QUESTION = (
    "Name every kind of object, furniture and surface that is clearly visible in this picture of a room, walls and "
    "floor included. Answer with a JSON list of short singular English nouns and nothing else, for example "
    '["wall", "floor", "office chair", "mug"].'
)

_MOST_NAMES = 100
"""Most names in one picture: a model that lists more repeats itself."""
_LONGEST_NAME = 40
_LONGEST_ANSWER = 16_384
"""Characters of an answer that are read; a longer one repeats itself."""
_MOST_WORDS = 4
_MOSTLY = 0.8
"""Share of the entries of a list without JSON that must be names, because sentences have commas, too."""
_SENTENCE = {"i", "it", "you", "we", "is", "are", "there", "can", "cannot", "not", "sorry", "and", "or", "see", "which"}
"""Words that no name contains."""
_MOST_FAILURES = 3
"""After this many questions in a row without an answer, the others are not asked."""
_WIDTH = 768  # of the pictures in the questions
_JPEG_QUALITY = 85


class _Kept(msgspec.Struct):
    """The file of answers. of: identifies the questions.  answers: names by frame."""

    of: str
    answers: dict[str, list[str]]


class Namer:
    """Asks for the names in keyframes, and saves each answer in a file, so that an interrupted run can continue."""

    def __init__(self, options: Options, server: VisionServer):
        self.options = options
        self.server = server

    def names(
        self, keyframes: Sequence[Frame], path: Path, advance: Callable[[int], None]
    ) -> tuple[dict[str, Any], list[Notice]]:
        """What a map saves: the model, the frames with an answer, and the names with their counts and frames, the most
        frequent first; and warnings of failures.

        path: the file that keeps answers in the meantime.
        """
        answers = self._restored(path)
        asked: list[int] = []
        nothing: list[str] = []
        failed, failures = "", 0
        for keyframe in keyframes:
            asked.append(keyframe.index)
            if keyframe.index in answers or failures == _MOST_FAILURES:
                continue
            try:
                said = self.server.ask(QUESTION, _jpeg(keyframe.color))
            except ServerError as error:
                failed, failures = str(error), _MOST_FAILURES if error.final else failures + 1
                continue
            failures = 0
            answers[keyframe.index] = parse_names(said) or []
            if not answers[keyframe.index]:
                nothing.append(said)
            self._keep(path, answers)
            advance(len(asked))
        answered = {frame: answers[frame] for frame in asked if frame in answers}
        warnings: list[Notice] = []
        if failed:
            lacking = len(asked) - len(answered)
            text = f"The scene's vocabulary lacks {lacking} of {len(asked)} keyframes: {failed.rstrip('.')}."
            warnings.append(Notice("vocabulary-incomplete", text))
        if nothing:
            shown = shorten_to_line(nothing[0], 60) or "nothing"
            text = (
                f"{len(nothing)} of {len(answered)} answers of {self.options.model} contain no names. "
                f"The first: '{shown}'."
            )
            warnings.append(Notice("vocabulary-empty-answers", text))
        return aggregate_names(answered, self.options.model), warnings

    def _marks(self) -> str:
        """Identifies everything that answers depend on."""
        asked = [self.options.endpoint, self.options.model, QUESTION]
        return hashlib.sha256(json.dumps(asked).encode()).hexdigest()[:16]

    def _keep(self, path: Path, answers: dict[int, list[str]]) -> None:
        replace_text(path, seal(json.dumps({"of": self._marks(), "answers": answers})))

    def _restored(self, path: Path) -> dict[int, list[str]]:
        """Answers of an interrupted run to the same questions; empty if there is no readable file."""
        try:
            kept = as_type(parse_json(unseal(read_bytes(path, TEXT_BYTES))), _Kept)
            return {int(frame): names for frame, names in kept.answers.items()} if kept.of == self._marks() else {}
        except (OSError, ValueError):
            return {}


def load_namer(options: Options) -> Namer | None:
    """Makes the namer; None if no endpoint is given. Raises ConfigError if the endpoint is not an address, or if the
    environment variable of the key is not set."""
    if options.endpoint is None:
        return None
    resolve_address(options.endpoint)
    key = os.environ.get(options.api_key_env, "").strip() if options.api_key_env else None
    if options.api_key_env and not key:
        raise ConfigError(
            f"The environment variable {options.api_key_env}, named by vocabulary.api_key_env, is not set: set it to "
            "the server's key."
        )
    if key and not (key.isascii() and key.isprintable()):
        raise ConfigError(
            f"The environment variable {options.api_key_env} does not contain a key: it is not plain text."
        )
    server = VisionServer(options.endpoint, options.model, key, options.timeout, options.retries)
    return Namer(options, server)


def aggregate_names(answers: dict[int, list[str]], model: str) -> dict[str, Any]:
    """Names over frames, as a map saves them: plain numbers and strings."""
    frames: dict[str, list[int]] = {}
    for frame, names in answers.items():
        for name in dict.fromkeys(names):
            frames.setdefault(name, []).append(frame)
    order = sorted(frames, key=lambda name: (-len(frames[name]), name))
    counted = {name: {"count": len(frames[name]), "keyframes": frames[name]} for name in order}
    return {"model": model, "keyframes": list(answers), "names": counted}


def parse_names(text: str) -> list[str] | None:
    """The names in an answer in normal form, without repetition; None if the answer is not a list of names.

    Accepts a JSON list, alone or with words around it, a JSON object that contains one, lines with bullets or numbers,
    and names separated by commas. Ignores what a model thinks aloud first (<think>).
    """
    text = re.sub(r"<think>.*?(</think>|\Z)", " ", text, flags=re.DOTALL).strip()
    if len(text) > _LONGEST_ANSWER:
        text = text[: max(text.rfind(mark, 0, _LONGEST_ANSWER) for mark in (",", "\n")) + 1]
    names = list(filter(None, map(_name, _json_list(text))))
    for entries in (_lines(text), text.strip().rstrip(".").split(",")):
        if not names:
            found = list(filter(None, map(_name, entries)))
            names = found if len(found) >= max(2, _MOSTLY * len(entries)) else []
    distinct = list(dict.fromkeys(names))
    return distinct if 0 < len(distinct) <= _MOST_NAMES else None


def _json_list(text: str) -> list[Any]:
    """The first JSON list in a text that is not empty."""
    decoder = json.JSONDecoder()
    for match in list(re.finditer(r"\[", text))[:20]:
        try:
            found, _ = decoder.raw_decode(text, match.start())
        except (ValueError, RecursionError):
            continue
        if isinstance(found, list) and found:
            return found
    return []


def _lines(text: str) -> list[str]:
    """The text after the bullets or numbers of a list."""
    found = (re.match(r"(?:[-*•]|\d{1,3}[.)])\s+(.+)", line.strip()) for line in text.splitlines())
    return [match[1] for match in found if match]


def _name(entry: Any) -> str:
    """A name in normal form; empty if the entry is not a name."""
    if isinstance(entry, dict):
        entry = next((entry[key] for key in ("name", "object", "label") if key in entry), None)
    if not isinstance(entry, str) or len(entry) > 4 * _LONGEST_NAME:
        return ""
    name = normalize_phrase(re.sub(r"\(.*?\)|[*_`\"]", " ", entry))
    words = name.split()
    long_enough = len(name) > 1 or not name.isascii()
    fits = long_enough and len(name) <= _LONGEST_NAME and len(words) <= _MOST_WORDS and not _SENTENCE & set(words)
    return name if fits and not any(c.isdigit() for c in name) else ""


def _jpeg(rgb: NDArray[np.uint8]) -> bytes:
    """A picture as JPEG, at the size for questions."""
    import cv2

    height, width = rgb.shape[:2]
    if width > _WIDTH:
        rgb = cv2.resize(rgb, (_WIDTH, max(round(height * _WIDTH / width), 1)), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
