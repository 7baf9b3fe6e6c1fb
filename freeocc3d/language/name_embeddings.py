"""Text embeddings of many names, to find names that mean one of a few classes: "couch" means a sofa, even if no list of
synonyms contains it.

Similarities of text embeddings are close together (with CLIP, sofa and couch 0.95, sofa and chair 0.85, sofa and banana
0.74), and closer for some names than for others, so no fixed cosine means "the same". Instead, the similarity of two
names is compared with the similarity of each to its own neighbors among all names:

    csls(w, c) = 2 cos(w, c) - r(w) - r(c),   r(x) the mean cosine of x to its K nearest other names.

A name means its nearest class if this value is at least a margin. Source: cross-domain similarity local scaling, A.
Conneau et al., Word Translation Without Parallel Data, ICLR 2018, eq. 3, with its K = 10; here within one list.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import read_arrays
from ..core.errors import ConfigError, MapError
from .synonyms import find_synonyms, make_key

_NEIGHBORS = 10
_ROWS = 1024
_MARGIN = 0.04
"""With CLIP's embeddings of 1374 names, this margin finds 73 % of the vocabulary's synonyms and gives each class 1.8
names. A plain cosine that finds the same share gives 4.5."""
_LEAST_NAMES = 100
"""Fewer names are not enough neighbors to compare a similarity with."""


@dataclass(frozen=True)
class NameEmbeddings:
    """names: N of them.  embeddings: (N, D) float32, unit length."""

    names: tuple[str, ...]
    embeddings: NDArray[np.float32]

    @classmethod
    def read(cls, path: Path) -> NameEmbeddings:
        """Reads an .npz file with ``names`` (N,) and ``embeddings`` (N, D) of any length. Raises ConfigError."""
        if not path.is_file():
            raise ConfigError(f"There is no file {path}: give an .npz file with 'names' and 'embeddings'.")
        try:
            arrays = read_arrays(path, {"names": ("U", 1), "embeddings": ("f", 2)})
        except MapError as error:
            raise ConfigError(str(error)) from error
        names, embeddings = arrays["names"], arrays["embeddings"].astype(np.float32)
        lengths = np.linalg.norm(embeddings, axis=1)
        if len(names) != len(embeddings) or not (np.isfinite(lengths) & (lengths > 0)).all():
            raise ConfigError(f"{path} must contain one finite, nonzero embedding for each of its names.")
        if len(names) < _LEAST_NAMES:
            raise ConfigError(f"{path} contains {len(names)} names, but the comparison needs at least {_LEAST_NAMES}.")
        return cls(tuple(map(str, names)), embeddings / lengths[:, None])

    def meaning(self, classes: Sequence[str]) -> dict[str, int]:
        """The names that mean a class: their ``synonyms.make_key`` -> the row of the class.

        A class that is not among the names is represented by a synonym that is; without such a synonym, no name means
        it.
        """
        row = {make_key(name): n for n, name in reversed(list(enumerate(self.names)))}
        known = [
            (c, row[key])
            for c, name in enumerate(classes)
            if (
                key := next(
                    (k for k in (make_key(name), *sorted(map(make_key, find_synonyms(name)))) if k in row), None
                )
            )
        ]
        if not known:
            return {}
        of_class, names_of_classes = np.array(known).T
        local = self._nearness
        scaled = 2 * self.embeddings @ self.embeddings[names_of_classes].T - local[:, None] - local[names_of_classes]
        best = scaled.argmax(axis=1)
        means = scaled[np.arange(len(best)), best] >= _MARGIN
        means[names_of_classes] = True
        return {key: int(of_class[best[n]]) for key, n in row.items() if means[n]}

    @cached_property
    def _nearness(self) -> NDArray[np.float32]:
        """(N,) mean cosine of each name to its nearest others."""
        out = np.empty(len(self.names), np.float32)
        for start in range(0, len(out), _ROWS):
            cosine = self.embeddings[start : start + _ROWS] @ self.embeddings.T
            cosine[np.arange(len(cosine)), start + np.arange(len(cosine))] = -np.inf
            out[start : start + _ROWS] = np.partition(cosine, -_NEIGHBORS, axis=1)[:, -_NEIGHBORS:].mean(axis=1)
        return out
