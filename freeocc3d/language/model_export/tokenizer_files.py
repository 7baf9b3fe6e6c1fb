"""Makes tokenizer.json of a model package, CLIP's or SigLIP's, including how texts are cut and padded."""

from __future__ import annotations

import json
from pathlib import Path

from ...core.errors import ModelError

_SIGLIP_PUNCTUATION = r"[!\"#$%&'()*+,\-./:;<=>?@\[\\\]^_`{|}~]"


def end_token(stated: int, tokenizer: str) -> int:
    """The number of the end token. CLIP's first configurations state 2, but mean the largest number of the
    vocabulary."""
    if stated != 2:
        return int(stated)
    from tokenizers import Tokenizer

    return int(Tokenizer.from_str(tokenizer).get_vocab_size()) - 1


def clip_tokenizer(tokenizer: str, length: int, fixed: bool = False) -> str:
    """tokenizer.json that cuts texts like CLIP, with the end token last, and pads them with end tokens to the longest;
    all to ``length`` with token 0, as in training, if that is fixed."""
    from tokenizers import Tokenizer

    made = Tokenizer.from_str(tokenizer)
    end = made.token_to_id("<|endoftext|>")
    if end is None:
        raise ModelError("The tokenizer has no <|endoftext|>: it is not a CLIP tokenizer.")
    made.enable_truncation(length)
    pad = 0 if fixed else end
    made.enable_padding(pad_id=pad, pad_token=made.id_to_token(pad) or "", length=length if fixed else None)
    return str(made.to_str())


def siglip_tokenizer(tokenizer: str, length: int, pad_id: int, without_punctuation: bool = True) -> str:
    """tokenizer.json that, like SigLIP, lowers texts, removes punctuation (SigLIP 2 keeps it), and cuts and pads texts
    to ``length``."""
    from tokenizers import Regex, Tokenizer, normalizers

    made = Tokenizer.from_str(tokenizer)
    own = [] if made.normalizer is None else [made.normalizer]
    cleaning = [
        normalizers.Replace(Regex(_SIGLIP_PUNCTUATION), ""), normalizers.Replace(Regex(r"\s+"), " "),
        normalizers.Strip(),
    ] if without_punctuation else []  # fmt: skip
    made.normalizer = normalizers.Sequence([normalizers.Lowercase(), *cleaning, *own])
    made.enable_truncation(length)
    made.enable_padding(pad_id=pad_id, pad_token=made.id_to_token(pad_id) or "", length=length)
    return str(made.to_str())


def clip_tokenizer_from(vocabulary: dict[str, int], merges: list[tuple[str, str]]) -> str:
    """tokenizer.json from CLIP's vocab.json and merges.txt: byte-level BPE of lower-case words that end with </w>."""
    from tokenizers import Regex, Tokenizer, normalizers, pre_tokenizers, processors
    from tokenizers.models import BPE

    start, end = "<|startoftext|>", "<|endoftext|>"
    made = Tokenizer(
        BPE(vocabulary, merges, continuing_subword_prefix="", end_of_word_suffix="</w>", fuse_unk=False, unk_token=end)
    )
    made.normalizer = normalizers.Sequence(
        [normalizers.NFC(), normalizers.Replace(Regex(r"\s+"), " "), normalizers.Lowercase()]
    )
    words = r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"
    made.pre_tokenizer = pre_tokenizers.Sequence(
        [pre_tokenizers.Split(Regex(words), behavior="removed", invert=True),
         pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)]
    )  # fmt: skip
    made.post_processor = processors.TemplateProcessing(
        single=f"{start} $A {end}", special_tokens=[(token, vocabulary[token]) for token in (start, end)]
    )
    return str(made.to_str())


def read_tokenizer(folder: Path) -> str:
    """tokenizer.json of a folder, or the one made from vocab.json and merges.txt. Raises ModelError."""
    try:
        if (folder / "tokenizer.json").is_file():
            return (folder / "tokenizer.json").read_text(encoding="utf-8")
        vocabulary = json.loads((folder / "vocab.json").read_text(encoding="utf-8"))
        lines = (folder / "merges.txt").read_text(encoding="utf-8").splitlines()
        pairs = [line.split() for line in lines if line and not line.startswith("#version")]
        return clip_tokenizer_from(vocabulary, [(left, right) for left, right in pairs])
    except (OSError, ValueError, KeyError) as error:
        raise ModelError(f"{folder} has neither tokenizer.json nor vocab.json with merges.txt: {error}.") from error
