"""The text side of a model package: its tokenizer against CLIP's, its network, and its cache on disk."""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import regex
import tiny_models
import torch
from tokenizers import Tokenizer

from freeocc3d.core.errors import MapError, ModelError
from freeocc3d.language import model_packages
from freeocc3d.language.encoders import clip
from freeocc3d.language.model_export.checkpoint_networks import build_siglip
from freeocc3d.language.model_export.package_writer import write_package
from freeocc3d.language.model_export.tokenizer_files import clip_tokenizer

ALPHABETS = (
    "abcdefghijklmnopqrstuvwxyz", "ABCDEFGHIJ KLM", "0123456789 .,;:!?'\"()-_/&@#%", "äöüßéèêñçøåœ",
    "абвгдежзиклмн СТУ",
    "椅子桌窓部屋書架の赤い", "κουζίνα τραπέζι", "كرسي طاولة", "कुर्सी मेज़", "😀🪑🛋️🇩🇪", "ﬁⅧ½²ſİ", " \t\n\u00a0\u3000",
)  # fmt: skip


def strings() -> list[str]:
    """1,000: words of rooms, contractions, other scripts, and texts longer than CLIP takes."""
    rng = np.random.default_rng(5)
    found = ["", " ", "a photo of a red chair.", "It's the lamp we've got; THEY'RE   here", "don't", "x" * 10_000,
             "the chair " * 200, "椅子" * 300, "\ufeffsofa", "e\u0301le\u0301gant",
             "tab\tbed"]  # fmt: skip
    while len(found) < 1000:
        letters = "".join(ALPHABETS[k] for k in rng.choice(len(ALPHABETS), rng.integers(1, 4)))
        length = int(rng.choice([3, 8, 20, 60, 200]))
        found.append("".join(letters[k] for k in rng.integers(0, len(letters), length)))
    return found


def reference_tokens(text: str) -> list[int]:
    """CLIP's own tokenizer, as its paper's code does it: lower case, words, byte pairs, cut with the end token last."""
    import unicodedata

    vocabulary, merges = tiny_models.vocabulary()
    ranks = {pair: rank for rank, pair in enumerate(merges)}
    characters = tiny_models.byte_characters()
    text = re.sub(r"\s+", " ", unicodedata.normalize("NFC", text)).lower()
    words = regex.findall(
        r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+", text
    )
    numbers = []
    for word in words:
        parts = [characters[byte] for byte in word.encode()]
        parts[-1] += "</w>"
        while len(parts) > 1:
            pairs = [(ranks.get(pair, len(ranks)), at) for at, pair in enumerate(itertools.pairwise(parts))]
            rank, at = min(pairs)
            if rank == len(ranks):
                break
            parts[at : at + 2] = [parts[at] + parts[at + 1]]
        numbers += [vocabulary[part] for part in parts]
    start, end = vocabulary[tiny_models.START], vocabulary[tiny_models.END]
    return [start, *numbers[:75], end]


def unpadded(tokenizer: str) -> Tokenizer:
    made = Tokenizer.from_str(tokenizer)
    made.no_padding()
    return made


def test_the_tokenizer_equals_clips_own_on_1000_strings() -> None:
    made = unpadded(clip_tokenizer(tiny_models.tokenizer(), 77))
    texts = strings()
    for text, encoding in zip(texts, made.encode_batch(texts), strict=True):
        assert encoding.ids == reference_tokens(text), repr(text[:80])


def test_the_tokenizer_equals_transformers_on_1000_strings() -> None:
    from transformers import CLIPTokenizer

    vocabulary, merges = tiny_models.vocabulary()
    theirs = CLIPTokenizer(vocab=vocabulary, merges=merges)
    made = unpadded(clip_tokenizer(tiny_models.tokenizer(), 77))
    texts = strings()
    expected = theirs(texts, truncation=True, max_length=77)["input_ids"]
    assert [encoding.ids for encoding in made.encode_batch(texts)] == [list(row) for row in expected]


def test_texts_are_cut_to_what_clip_takes_and_padded_to_the_longest() -> None:
    made = Tokenizer.from_str(clip_tokenizer(tiny_models.tokenizer(), 77))
    long, short = (encoding.ids for encoding in made.encode_batch(["chair " * 500, "sofa"]))
    assert len(long) == len(short) == 77
    end = tiny_models.vocabulary()[0][tiny_models.END]
    assert long[-1] == end
    assert long.count(end) == 1
    assert short[short.index(end) :] == [end] * (77 - short.index(end))


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> model_packages.Package:
    return model_packages.read_package(tiny_models.clip_package(tmp_path_factory.mktemp("models") / "tiny-clip"))


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty models folder."""
    monkeypatch.setenv("FREEOCC3D_MODELS", str(tmp_path / "models"))
    return tmp_path / "models"


def state(package: model_packages.Package, **options: Any) -> dict[str, Any]:
    return clip.Options(model="x", **options).wording.state(package)


def text_features(texts: list[str]) -> np.ndarray:
    """Unit features of transformers' own forward pass, one text at a time, without padding."""
    made = unpadded(clip_tokenizer(tiny_models.tokenizer(), 77))
    model, rows = tiny_models.clip(), []
    for text in texts:
        with torch.no_grad():
            found = model.get_text_features(torch.tensor([made.encode(text).ids]))
        rows.append(getattr(found, "pooler_output", found)[0].numpy())
    features = np.array(rows)
    return features / np.linalg.norm(features, axis=1, keepdims=True)


def test_words_equal_transformers_forward_pass(package: model_packages.Package, home: Path) -> None:
    words = clip.load_text(state(package, templates=("a photo of a {}.", "{}")))
    asked = ["Red  Chair", "椅子", "κουζίνα", "lamp " * 30]
    found = words.encode_words(asked)
    plain = ["red chair", "椅子", "κουζίνα", " ".join(["lamp"] * 30)]
    prompts = [prompt for word in plain for prompt in (f"a photo of a {word}.", word)]
    expected = text_features(prompts).reshape(4, 2, -1).mean(axis=1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.abs(found.features - expected).max() < 1e-4
    assert found.understood == tuple(plain)


def test_a_word_of_nothing_is_not_understood(package: model_packages.Package, home: Path) -> None:
    found = clip.load_text(state(package)).encode_words(["  ", "chair"])
    assert found.understood == ("", "chair")
    assert not found.features[0].any()
    assert found.features[1].any()


def test_braces_in_words_are_words(package: model_packages.Package, home: Path) -> None:
    words = clip.load_text(state(package, templates=("a {}.",)))
    found = words.encode_words(["{}", "{0.__class__}"])
    assert np.abs(found.features - text_features(["a {}.", "a {0.__class__}."])).max() < 1e-4


def test_a_repeated_word_needs_no_network(package: model_packages.Package, home: Path) -> None:
    asked = state(package)
    first = clip.load_text(asked).encode_words(["chair", "blue sofa"])
    script = (
        "import json, sys\n"
        "from freeocc3d.language.encoders import clip\n"
        "words = clip.load_text(json.loads(sys.argv[1]))\n"
        "print(json.dumps(words.encode_words(['blue sofa', 'chair']).features.tolist()))\n"
        "assert not {'onnxruntime', 'tokenizers', 'torch', 'cv2', 'numba'} & set(sys.modules)\n"
    )
    gone = {**asked, "folder": "/nowhere"}
    done = subprocess.run([sys.executable, "-c", script, json.dumps(gone)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert np.array_equal(np.array(json.loads(done.stdout), np.float32), first.features[::-1])


def test_a_broken_cache_is_no_cache(package: model_packages.Package, home: Path) -> None:
    first = clip.load_text(state(package)).encode_words(["chair"]).features
    (cache,) = (home / ".embeddings").glob("*.npz")
    for content in (b"", cache.read_bytes()[:200], b"PK nonsense", np.lib.format.magic(1, 0)):
        cache.write_bytes(content)
        assert np.array_equal(clip.load_text(state(package)).encode_words(["chair"]).features, first)
    for value in (np.nan, 0, 1e30):
        np.savez(cache, words=np.array(["chair"]), features=np.full((1, 24), value, np.float32))
        assert np.array_equal(clip.load_text(state(package)).encode_words(["chair"]).features, first)


def test_a_words_meaning_does_not_depend_on_words_beside_it(home: Path, tmp_path: Path) -> None:
    """An int8 network rounds all texts of a batch by their common range."""
    asked = state(model_packages.read_package(tiny_models.clip_package(tmp_path / "int8", "int8")))
    together = clip.load_text(asked).encode_words(["floor lamp", "chair", "x" * 200]).features[1]
    (cache,) = (home / ".embeddings").glob("*.npz")
    cache.unlink()
    assert np.array_equal(clip.load_text(asked).encode_words(["chair"]).features[0], together)


def test_other_templates_are_other_embeddings(package: model_packages.Package, home: Path) -> None:
    one = clip.load_text(state(package, templates=("{}",))).encode_words(["chair"]).features
    other = clip.load_text(state(package, templates=("a drawing of a {}.",))).encode_words(["chair"]).features
    assert not np.allclose(one, other)


def test_the_text_side_is_found_by_its_content(package: model_packages.Package, home: Path, tmp_path: Path) -> None:
    moved = home / "renamed"
    home.mkdir()
    moved.symlink_to(package.folder)
    asked = {**state(package), "folder": str(tmp_path / "gone")}
    assert clip.load_text(asked).encode_words(["chair"]).features.any()
    asked["text_sha256"] = "0" * 64
    with pytest.raises(ModelError, match=r"need the text part of the model 'tiny-clip' \(000000000000…\)"):
        clip.load_text(asked).encode_words(["lamp"])


def test_a_text_side_of_another_dimension_is_reported(package: model_packages.Package, home: Path) -> None:
    with pytest.raises(ModelError, match="has 24 dimensions, but the map's features have 32"):
        clip.load_text({**state(package), "dimension": 32}).encode_words(["chair"])


def test_a_damaged_state_is_reported() -> None:
    with pytest.raises(MapError, match="encoder is damaged"):
        clip.load_text({"model": "x"})


def test_siglips_texts_are_lowered_stripped_and_of_one_length(tmp_path: Path, home: Path) -> None:
    made = tmp_path / "siglip"
    model = tiny_models.siglip()
    checkpoint = build_siglip(model, tiny_models.tokenizer(), [0.5] * 3, [0.5] * 3)
    write_package(checkpoint, made, made.name, "random weights", "none")
    found = clip.load_text(state(model_packages.read_package(made), templates=("{}",))).encode_words(
        ["Red, CHAIR!", "a" * 300]
    )
    tokens = [
        encoding.ids
        for encoding in Tokenizer.from_file(str(made / "tokenizer.json")).encode_batch(["red chair", "a" * 300])
    ]
    assert {len(row) for row in tokens} == {16}
    with torch.no_grad():
        expected = model.get_text_features(torch.tensor(tokens))
    expected = getattr(expected, "pooler_output", expected).numpy()
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.abs(found.features - expected).max() < 1e-4
