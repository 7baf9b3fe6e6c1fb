"""The names that mean a class, by the distances between their embeddings and those of other names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from small_captures import models_folder

from freeocc3d.core.errors import ConfigError
from freeocc3d.language.name_embeddings import NameEmbeddings
from freeocc3d.language.synonyms import SYNONYMS, make_key


def unit(values: NDArray[np.floating]) -> NDArray[np.float32]:
    return (values / np.linalg.norm(values, axis=-1, keepdims=True)).astype(np.float32)


def crowd(n: int = 300, dimension: int = 64, seed: int = 0) -> NDArray[np.float32]:
    """Unit vectors that all lie close together, as text embeddings do."""
    rng = np.random.default_rng(seed)
    return unit(rng.normal(size=(n, dimension)) + 2.0 * rng.normal(size=dimension))


def csls(embeddings: NDArray[np.float32], k: int = 10) -> NDArray[np.float64]:
    """(N, N) of Conneau et al., eq. 3, plain; infinite for a name with itself."""
    cosine = embeddings.astype(float) @ embeddings.T.astype(float)
    np.fill_diagonal(cosine, -np.inf)
    near = np.sort(cosine, axis=1)[:, -k:].mean(axis=1)
    scaled = 2 * cosine - near[:, None] - near[None]
    np.fill_diagonal(scaled, np.inf)
    return scaled


def test_names_mean_their_nearest_class_where_csls_says_so() -> None:
    embeddings = crowd()
    rng = np.random.default_rng(1)
    for n in range(40):  # some names are like others, more or less
        embeddings[n + 100] = unit(embeddings[n] + rng.uniform(0, 1.5) * unit(rng.normal(size=64)))
    names = tuple(f"name {chr(97 + n // 26)}{chr(97 + n % 26)}" for n in range(300))
    classes = [names[c] for c in range(60)]
    found = NameEmbeddings(names, embeddings).meaning(classes)
    scaled = csls(embeddings)[:, :60]
    means = scaled.max(axis=1) >= 0.04
    assert found == {make_key(names[w]): int(scaled[w].argmax()) for w in np.flatnonzero(means)}
    assert 65 < len(found) < 100


def test_a_class_that_is_not_among_the_names_is_known_by_a_synonym_or_not_at_all() -> None:
    embeddings = crowd()
    embeddings[1] = unit(embeddings[0] + 0.2 * embeddings[1])
    names = ("fridge", "coolbox", *(f"thing {chr(97 + n // 26)}{chr(97 + n % 26)}" for n in range(298)))
    found = NameEmbeddings(names, embeddings).meaning(["wall", "refrigerator"])
    assert found == {"fridge": 1, "coolbox": 1}
    assert NameEmbeddings(names, embeddings).meaning(["wall", "floor"]) == {}


def test_real_embeddings_find_synonyms_and_leave_others_alone() -> None:
    """The vocabulary's groups of synonyms are the judge: of two names of a group one is taken as a class. Raw cosines
    cannot do this: one that finds as many synonyms takes more names of other things."""
    real = NameEmbeddings.read(models_folder() / "clip_text_names.npz")
    row = {make_key(name): n for n, name in reversed(list(enumerate(real.names)))}
    groups = [[make_key(word) for word in group if make_key(word) in row] for group in SYNONYMS]
    pairs = [(group[0], other) for group in groups for other in group[1:] if len(group) > 1]
    right = sum(real.meaning([a]).get(b) == 0 for a, b in pairs)
    assert len(pairs) > 10
    assert right >= 0.6 * len(pairs)
    taken = [len(real.meaning([a])) - 1 for a, _ in pairs]
    assert np.mean(taken) < 5
    assert "banana" not in real.meaning(["sofa", "chair", "table"])
    assert real.meaning(["chair", "sofa"])["couch"] == 1


def test_files_that_cannot_be_used_are_reported(tmp_path: Path) -> None:
    def told(words: str, **arrays: NDArray[np.generic]) -> None:
        np.savez(tmp_path / "names.npz", **arrays)  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match=words):
            NameEmbeddings.read(tmp_path / "names.npz")

    names, embeddings = np.array([f"name {n}" for n in range(200)]), crowd(200)
    np.savez(tmp_path / "good.npz", names=names, embeddings=3 * embeddings)
    np.testing.assert_allclose(NameEmbeddings.read(tmp_path / "good.npz").embeddings, embeddings, atol=1e-6)
    told("no usable array 'names'", embeddings=embeddings)
    told("no usable array 'embeddings'", names=names, embeddings=embeddings[0])
    told("one finite, nonzero embedding", names=names[1:], embeddings=embeddings)
    told("one finite, nonzero embedding", names=names, embeddings=0 * embeddings)
    told("one finite, nonzero embedding", names=names, embeddings=np.where(np.eye(200, 64) > 0, np.nan, embeddings))
    told("at least 100", names=names[:50], embeddings=embeddings[:50])
    told("damaged", names=np.array([{"a": 1}] * 200, dtype=object), embeddings=embeddings)
    with pytest.raises(ConfigError, match=r"There is no file .*give an \.npz file"):
        NameEmbeddings.read(tmp_path / "absent.npz")
    (tmp_path / "text.npz").write_text("not an archive")
    with pytest.raises(ConfigError, match="damaged"):
        NameEmbeddings.read(tmp_path / "text.npz")
