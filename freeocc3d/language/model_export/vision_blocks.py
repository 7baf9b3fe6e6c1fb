"""Layers of image encoders that transformers does not have, made from a checkpoint's weights by name.

What is made takes its weights out of the dictionary, so that what is left over shows another architecture.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .transformer_graphs import heads_of


def part_of(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Takes the weights below ``prefix`` out, named from there on."""
    return {name.removeprefix(prefix): state.pop(name) for name in list(state) if name.startswith(prefix)}


def take_linear(state: dict[str, Tensor], name: str) -> nn.Linear:
    """A linear layer, with a bias or without. Raises KeyError."""
    weight, bias = state.pop(f"{name}.weight"), state.pop(f"{name}.bias", None)
    made = nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None)
    made.load_state_dict({"weight": weight} if bias is None else {"weight": weight, "bias": bias})
    return made


def take_norm(state: dict[str, Tensor], name: str, epsilon: float) -> nn.LayerNorm:
    """A layer norm. Raises KeyError."""
    weight = state.pop(f"{name}.weight")
    made = nn.LayerNorm(len(weight), epsilon)
    made.load_state_dict({"weight": weight, "bias": state.pop(f"{name}.bias")})
    return made


def refuse_rest(state: dict[str, Tensor]) -> None:
    """Raises KeyError for weights that nothing took."""
    if state:
        raise KeyError(f"nothing uses {min(state)}")


class Block(nn.Module):
    """A transformer's block, with the names that timm gives its weights: with two layers or SwiGLU (w1, w2, w3) after
    the attention, and with a scale of each channel (ls1, ls2) or without. Raises KeyError for other weights."""

    def __init__(self, state: dict[str, Tensor], heads: int, epsilon: float):
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = take_norm(state, "norm1", epsilon), take_norm(state, "norm2", epsilon)
        self.qkv, self.proj = take_linear(state, "attn.qkv"), take_linear(state, "attn.proj")
        gated = "mlp.w1.weight" in state
        names = ("mlp.w1", "mlp.w2", "mlp.w3") if gated else ("mlp.fc1", "mlp.fc2")
        self.layers = nn.ModuleList(take_linear(state, name) for name in names)
        one = torch.ones(len(self.norm1.weight))
        self.register_buffer("scale1", state.pop("ls1.gamma", one))
        self.register_buffer("scale2", state.pop("ls2.gamma", one))
        refuse_rest(state)

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = self.queries_keys_values(x)
        return self.after(x, self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)))

    def queries_keys_values(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Each (B, heads, N, d), of (B, N, C)."""
        q, k, v = (heads_of(part, self.heads) for part in self.qkv(self.norm1(x)).chunk(3, dim=-1))
        return q, k, v

    def after(self, x: Tensor, attended: Tensor) -> Tensor:
        """The block's output from its input and its projected attention."""
        x = x + self.scale1 * attended
        y = self.norm2(x)
        first, *gate, last = self.layers
        return x + self.scale2 * last(F.silu(first(y)) * gate[0](y) if gate else F.gelu(first(y)))
