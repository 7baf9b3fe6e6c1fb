"""The text part of an encoder whose text network is in a model package.

It is restored from the state that a map saved, and finds the package by its content, not by its path. onnxruntime and
tokenizers are imported only when a word is encoded for the first time: embeddings are kept on disk, and a repeated
query needs neither.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import read_arrays, write_arrays
from ..core.errors import ConfigError, MapError, ModelError
from ..core.regular_files import read_text
from ..core.typed_documents import InvalidDocument, as_type
from . import model_packages
from .encoders.base import TextEncoder, TextFeatures
from .vision_server import shorten_to_line
from .word_matching import CANONICAL

TEMPLATES = ("a photo of a {}.", "a photo of the {} in a room.", "there is a {} in the scene.", "a bad photo of a {}.",
             "a photo of a small {}.", "a photo of a large {}.", "{}")  # fmt: skip
"""Prompts for a word; their mean is its meaning. The form is that of CLIP's own ensemble, for things in rooms."""

CONTRAST = (
    "wall", "floor", "ceiling", "door", "window", "table", "chair", "sofa", "bed", "cabinet", "shelf", "desk",
    "curtain", "lamp", "picture", "plant", "pillow", "television", "sink", "toilet", *CANONICAL,
)  # fmt: skip
"""What else a voxel could be: things in most rooms, and words that fit anything."""

_KEPT = 4096  # the latest embeddings, kept in a cache file
_LONGEST = 200  # characters of a word; longer ones are not cached
_AT_ONCE = 64
_LARGEST_TOKENIZER = 64 << 20
_MOST_TOKENS = 4096


@dataclass(frozen=True)
class Wording:
    """How words become prompts, and the words that they compete with."""

    templates: tuple[str, ...] = TEMPLATES
    contrast: tuple[str, ...] = CONTRAST
    threshold: float | None = None

    def check(self) -> None:
        """Raises ConfigError for templates without a place for the word."""
        if not self.templates or any("{}" not in template for template in self.templates):
            raise ConfigError("Each of 'templates' must contain {}, the place of the word.")
        if any(not word.strip() for word in self.contrast):
            raise ConfigError("'contrast' must not contain empty words.")

    def state(self, package: model_packages.Package) -> dict[str, Any]:
        """The state that ``ModelWords`` is restored from."""
        return {
            "model": package.name,
            "folder": str(package.folder.resolve()),
            "text_sha256": package.text_sha256,
            "dimension": package.dimension,
            "temperature": 1.0 / package.logit_scale,
            "templates": list(self.templates),
            "contrast": list(self.contrast),
            "threshold": self.threshold,
        }


class _State(msgspec.Struct):
    """What a map keeps of an encoder whose words a text network embeds."""

    threshold: Annotated[float, msgspec.Meta(ge=-1, le=1)] | None
    temperature: Annotated[float, msgspec.Meta(gt=0, le=1000)]
    dimension: Annotated[int, msgspec.Meta(ge=1, le=1 << 16)]
    templates: Annotated[list[str], msgspec.Meta(min_length=1, max_length=10_000)]
    contrast: Annotated[list[str], msgspec.Meta(max_length=10_000)]
    model: str
    folder: str
    text_sha256: str


class ModelWords(TextEncoder):
    """Any words; words that the network was not trained on get a feature, too."""

    open_vocabulary = True
    knows = "words in the language of its text network"

    def __init__(self, state: dict[str, Any]):
        try:
            kept = as_type(state, _State)
        except InvalidDocument as error:
            raise MapError(f"The map's encoder is damaged: its state has no usable value: {error}.") from error
        self.threshold, self.temperature, self._dimension = kept.threshold, kept.temperature, kept.dimension
        self._templates, self._contrast = kept.templates, kept.contrast
        self._model, self._folder, self._sha256 = kept.model, kept.folder, kept.text_sha256
        key = hashlib.sha256("\n".join((self._sha256, *self._templates)).encode()).hexdigest()[:32]
        self._cache = model_packages.find_models_folder() / ".embeddings" / f"{key}.npz"
        self._known: dict[str, NDArray[np.float32]] | None = None
        self._text: TextNetwork | None = None

    def contrast_words(self) -> list[str]:
        return self._contrast

    def encode_words(self, words: list[str]) -> TextFeatures:
        """(W, D) unit means of the prompts' embeddings. Raises ModelError if the text part is not found."""
        plain = [" ".join(word.lower().split()) for word in words]
        if self._known is None:
            self._known = _read_cache(self._cache, self._dimension)
        new = [word for word in dict.fromkeys(plain) if word and word not in self._known]
        if new:
            if self._text is None:
                package = model_packages.find_text_model(self._model, self._folder, self._sha256)
                self._text = TextNetwork(package)
                if package.dimension != self._dimension:
                    raise ModelError(
                        f"The text part of {package.folder} has {package.dimension} dimensions, but the map's features "
                        f"have {self._dimension}: reconstruct the map."
                    )
            embedded = np.stack([self._embed_prompts(self._text, word) for word in new])
            norms = np.linalg.norm(embedded, axis=1, keepdims=True)
            embedded /= np.where(norms > 0, norms, 1)
            self._known.update(zip(new, embedded, strict=True))
            _write_cache(self._cache, self._known)
        empty = np.zeros(self._dimension, np.float32)
        features = [self._known[word] if word else empty for word in plain]
        return TextFeatures(np.array(features, np.float32).reshape(len(words), self._dimension), tuple(plain))

    def _embed_prompts(self, network: TextNetwork, word: str) -> NDArray[np.float32]:
        """(D,) mean embedding of a word's prompts. They are embedded apart from those of other words: an int8 network
        rounds all texts of a batch by their common range, so a word's meaning would depend on its company."""
        return network.embed([template.replace("{}", word) for template in self._templates]).mean(axis=0)


class TextNetwork:
    """A package's text network with its tokenizer. Raises ModelError for unusable files."""

    def __init__(self, package: model_packages.Package):
        try:
            from tokenizers import Tokenizer
        except ImportError as error:
            raise ModelError("Encoding words needs the package tokenizers: pip install 'freeocc3d[models]'.") from error
        self._path = package.file("tokenizer")
        with self._failing("is not a tokenizer.json"):
            self._tokenizer = Tokenizer.from_str(read_text(self._path, _LARGEST_TOKENIZER))
        self._refuse_endless_texts()
        self._package = package
        self._network = package.session("text")

    def tokens(self, texts: list[str]) -> NDArray[np.int64]:
        """(T, L) token numbers; the tokenizer file defines how texts are cut and padded. Raises ModelError."""
        with self._failing("fails on a text"):
            rows = [encoding.ids for encoding in self._tokenizer.encode_batch(texts)]
        if len({len(row) for row in rows}) > 1:
            raise ModelError(
                f"{self._package.folder}/{self._package.parts['tokenizer']} does not pad texts: export it again."
            )
        return np.array(rows, np.int64)

    @contextlib.contextmanager
    def _failing(self, what: str) -> Iterator[None]:
        """Raises ModelError for what tokenizers raises: bare Exceptions, and panics that are none."""
        try:
            yield
        except OSError as error:
            raise ModelError(f"Cannot read {self._path}: {error.strerror}.") from error
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:
            raise ModelError(f"{self._path} {what}: {shorten_to_line(str(error), 200)}.") from error

    def embed(self, texts: list[str]) -> NDArray[np.float32]:
        """(T, D) unit embeddings."""
        parts = []
        for start in range(0, len(texts), _AT_ONCE):
            tokens = self.tokens(texts[start : start + _AT_ONCE])
            shapes = {"features": (len(tokens), self._package.dimension)}
            (features,) = self._network.run(["features"], {"tokens": tokens}, shapes)
            norms = np.linalg.norm(features, axis=1, keepdims=True)
            if not (norms > 0).all():
                raise ModelError(f"{self._network.path} gives a text no meaning, zeros alone: export it again.")
            parts.append(features / norms)
        return np.concatenate(parts).astype(np.float32)

    def _refuse_endless_texts(self) -> None:
        """Raises ModelError if texts would be padded to more tokens than any network reads."""
        padding, truncation = (getattr(self._tokenizer, name) or {} for name in ("padding", "truncation"))
        lengths = [padding.get("length"), padding.get("pad_to_multiple_of"), truncation.get("max_length")]
        longest = max((length for length in lengths if length is not None), default=0)
        if longest > _MOST_TOKENS:
            raise ModelError(f"{self._path} makes texts of {longest} tokens, which no network reads: export it again.")


def _read_cache(path: Path, dimension: int) -> dict[str, NDArray[np.float32]]:
    """Embeddings by word; empty if the file is unusable."""
    try:
        arrays = read_arrays(path, {"words": ("U", 1), "features": ("f", 2)})
    except MapError:
        return {}
    words, features = arrays["words"], arrays["features"]
    fit = features.shape == (len(words), dimension)
    if not fit or not np.allclose(np.linalg.norm(features.astype(np.float64), axis=1), 1, atol=1e-3):
        return {}
    features = features.astype(np.float32)
    return dict(zip(words.tolist(), features, strict=True))


def _write_cache(path: Path, known: dict[str, NDArray[np.float32]]) -> None:
    """Saves embeddings for later processes; if that fails, they compute the embeddings again."""
    kept = [word for word in list(known)[-_KEPT:] if len(word) <= _LONGEST]
    arrays = {"words": np.array(kept, dtype=str), "features": np.array([known[word] for word in kept])}
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, arrays)
