"""Replacements for the attention of CLIP's last block, so that patches, and not only the class token, have a meaning in
words. They need no training: the weights stay as they are.

    plain       softmax(q k^T s) v, with the residual and the feed-forward part: the network as it was trained
    maskclip    v: every patch attends to itself (Zhou et al., Extract Free Dense Labels from CLIP, ECCV 2022)
    sclip       (softmax(q q^T s) + softmax(k k^T s)) v, with the residual and the feed-forward part (Wang et al.,
                ECCV 2024)
    clearclip   softmax(q q^T s) v, without both (Lan et al., ECCV 2024)
    naclip      softmax(k k^T s + w) v, without both; w_ij = exp(-|p_i - p_j|^2 / (2 5^2)) of patches i and j at p, in
                patches (Hajimiri et al., Pay Attention to Your Neighbours, WACV 2025)

with s = 1 / sqrt(d). On the same eight benchmarks with ViT-B/16, SCLIP's paper reports a mean IoU of 14.1 for plain and
38.2 for sclip. NACLIP's paper reports better results than the earlier ones on most of them, so naclip is the default.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

KEEPS_REST = {"plain": True, "maskclip": False, "sclip": True, "clearclip": False, "naclip": False}
"""Attention -> whether the block keeps its residual and feed-forward part."""

NEIGHBORHOOD = 5.0
"""Standard deviation of naclip's window, in patches."""


def mix_values(
    attention: str,
    queries: NDArray[np.float32],
    keys: NDArray[np.float32],
    values: NDArray[np.float32],
    grid: tuple[int, int],
) -> NDArray[np.float32]:
    """(B, N, heads d) mixed values from (B, heads, N, d) queries, keys and values. The last h w = N - prefix of them
    belong to a grid of (h, w) patches."""
    if attention == "maskclip":
        return join_heads(values)
    if attention == "plain":
        weights = apply_softmax(_products(queries, keys))
    elif attention == "sclip":
        weights = apply_softmax(_products(queries, queries))
        weights += apply_softmax(_products(keys, keys))
    elif attention == "clearclip":
        weights = apply_softmax(_products(queries, queries))
    else:
        logits = _products(keys, keys)
        prefix = keys.shape[2] - grid[0] * grid[1]
        logits[..., prefix:, prefix:] += weigh_neighbors(*grid)
        weights = apply_softmax(logits)
    return join_heads(weights @ values)


def _products(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """(B, heads, N, N) scaled dot products s a b^T."""
    return np.asarray(np.float32(a.shape[-1] ** -0.5) * a @ b.swapaxes(-1, -2), np.float32)


def weigh_neighbors(height: int, width: int) -> NDArray[np.float32]:
    """(h w, h w) naclip's w, by which near patches attend to each other."""
    rows, columns = (
        np.exp(-0.5 * ((np.arange(n)[:, None] - np.arange(n)) / NEIGHBORHOOD) ** 2) for n in (height, width)
    )
    return np.kron(rows, columns).astype(np.float32)


def apply_softmax(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Softmax over the last axis; overwrites its argument."""
    logits -= logits.max(axis=-1, keepdims=True)
    np.exp(logits, out=logits)
    logits /= logits.sum(axis=-1, keepdims=True)
    return logits


def join_heads(heads: NDArray[np.float32]) -> NDArray[np.float32]:
    """(B, heads, N, d) to (B, N, heads d)."""
    batch, _, tokens, _ = heads.shape
    return np.ascontiguousarray(heads.transpose(0, 2, 1, 3)).reshape(batch, tokens, -1)
