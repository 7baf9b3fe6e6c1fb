"""The networks of a model package as PyTorch modules around the layers of transformers' models, ready for export.

Position embeddings are interpolated inside the graphs, bicubically as in transformers, so that images can have any size
(in patches). Attention is written out, so that the last block can be cut before it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F


def heads_of(x: Tensor, heads: int) -> Tensor:
    """(B, N, heads d) to (B, heads, N, d)."""
    return x.unflatten(-1, (heads, -1)).transpose(1, 2)


def clip_block(layer: nn.Module, x: Tensor, mask: Tensor | None = None) -> Tensor:
    """A block of CLIP's and SigLIP's transformers."""
    own = layer.self_attn
    y = layer.layer_norm1(x)
    q, k, v = (heads_of(project(y), own.num_heads) for project in (own.q_proj, own.k_proj, own.v_proj))
    x = x + own.out_proj(F.scaled_dot_product_attention(q, k, v, attn_mask=mask).transpose(1, 2).flatten(2))
    return x + layer.mlp(layer.layer_norm2(x))


def positions(
    table: Tensor, grid: int, height: int, width: int, antialias: bool = False, mode: str = "bicubic"
) -> Tensor:
    """(1, height width, C) interpolated from (grid², C) position embeddings."""
    square = table.reshape(1, grid, grid, -1).permute(0, 3, 1, 2)
    fitted = F.interpolate(square, size=(height, width), mode=mode, align_corners=False, antialias=antialias)
    return fitted.flatten(2).transpose(1, 2)


def as_convolution(linear: nn.Linear, patch: int) -> nn.Conv2d:
    """The convolution of images that equals a layer on flattened (patch, patch, RGB) pixels of patches."""
    made = nn.Conv2d(3, linear.out_features, patch, patch)
    weight = linear.weight.detach().reshape(-1, patch, patch, 3).permute(0, 3, 1, 2)
    made.load_state_dict({"weight": weight, "bias": linear.bias.detach()})
    return made


class ImageTrunk(nn.Module):
    """The vision tower of CLIP, SigLIP or SigLIP 2 NaFlex up to the last block's queries, keys and values. NaFlex takes
    flattened patches, and interpolates its positions linearly, with antialiasing."""

    def __init__(self, vision: nn.Module):
        super().__init__()
        own = vision.embeddings
        self.patches, self.layers = own.patch_embedding, vision.encoder.layers
        self.before = getattr(vision, "pre_layrnorm", nn.Identity())
        table = own.position_embedding.weight.detach()
        self.mode = "bicubic"
        if isinstance(self.patches, nn.Linear):
            self.patches, self.mode = as_convolution(self.patches, own.patch_size), "bilinear"
        self.grid = int(len(table) ** 0.5)
        self.prefix = len(table) - self.grid**2
        self.register_buffer("table", table[self.prefix :])
        first = own.class_embedding.detach() + table[0] if self.prefix else torch.zeros(0, table.shape[1])
        self.register_buffer("first", first.reshape(1, self.prefix, table.shape[1]))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        x = self.patches(image)
        height, width = x.shape[-2:]
        x = x.flatten(2).transpose(1, 2) + positions(
            self.table, self.grid, height, width, self.mode == "bilinear", self.mode
        )
        if self.prefix:
            x = torch.cat((self.first.expand(x.shape[0], -1, -1), x), dim=1)
        x = self.before(x)
        for layer in self.layers[:-1]:
            x = clip_block(layer, x)
        last = self.layers[-1]
        y, own = last.layer_norm1(x), last.self_attn
        q, k, v = (heads_of(project(y), own.num_heads) for project in (own.q_proj, own.k_proj, own.v_proj))
        return q, k, v, x


class ClipHead(nn.Module):
    """Maps mixed values to CLIP's space, with and without the block's residual and feed-forward part."""

    def __init__(self, model: nn.Module):
        super().__init__()
        self.last, self.norm = model.vision_model.encoder.layers[-1], model.vision_model.post_layernorm
        self.project = model.visual_projection

    def forward(self, mixed: Tensor, stream: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        own = self.last.self_attn.out_proj(mixed)
        x = stream + own
        x = x + self.last.mlp(self.last.layer_norm2(x))
        features = self.project(self.norm(x))
        return features, self.project(self.norm(own)), features[:, 0]


class SiglipHead(nn.Module):
    """Maps mixed values to SigLIP's space. SigLIP's pooling attends to the patches with a learned query. The feature of
    a patch is the result of pooling that patch alone."""

    def __init__(self, model: nn.Module):
        super().__init__()
        self.last, self.norm = model.vision_model.encoder.layers[-1], model.vision_model.post_layernorm
        self.pool = model.vision_model.head

    def forward(self, mixed: Tensor, stream: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        own = self.last.self_attn.out_proj(mixed)
        x = stream + own
        x = self.norm(x + self.last.mlp(self.last.layer_norm2(x)))
        return self._alone(x), self._alone(self.norm(own)), self._pooled(x)

    def _projections(self) -> tuple[tuple[Tensor, Tensor], ...]:
        own = self.pool.attention
        return tuple(zip(own.in_proj_weight.chunk(3), own.in_proj_bias.chunk(3), strict=True))

    def _alone(self, x: Tensor) -> Tensor:
        return self._after(self.pool.attention.out_proj(F.linear(x, *self._projections()[2])))

    def _pooled(self, x: Tensor) -> Tensor:
        own = self.pool.attention
        sides = (self.pool.probe.expand(x.shape[0], -1, -1), x, x)
        q, k, v = (heads_of(F.linear(y, *p), own.num_heads) for y, p in zip(sides, self._projections(), strict=True))
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        return self._after(own.out_proj(mixed))[:, 0]

    def _after(self, y: Tensor) -> Tensor:
        return y + self.pool.mlp(self.pool.layernorm(y))


class ClipText(nn.Module):
    """CLIP's text tower: the embedding at the first end token. head: what follows the projection, if anything."""

    def __init__(self, model: nn.Module, end_token: int, head: nn.Module | None = None):
        super().__init__()
        text = model.text_model
        self.tokens, self.layers, self.norm = (
            text.embeddings.token_embedding,
            text.encoder.layers,
            text.final_layer_norm,
        )
        self.register_buffer("table", text.embeddings.position_embedding.weight.detach())
        length = len(self.table)
        self.register_buffer("mask", torch.full((length, length), float("-inf")).triu(1))
        self.project, self.head, self.end_token = model.text_projection, head or nn.Identity(), end_token

    def forward(self, tokens: Tensor) -> Tensor:
        length = tokens.shape[1]
        x = self.tokens(tokens) + self.table[:length]
        for layer in self.layers:
            x = clip_block(layer, x, self.mask[:length, :length])
        end = (tokens == self.end_token).to(torch.int32).argmax(dim=-1)
        x = torch.gather(self.norm(x), 1, end[:, None, None].expand(-1, 1, x.shape[-1]))[:, 0]
        return self.head(self.project(x))


class SiglipText(nn.Module):
    """SigLIP's text tower: the embedding at the last token; the number of tokens is fixed."""

    def __init__(self, model: nn.Module):
        super().__init__()
        text = model.text_model
        self.tokens, self.layers, self.norm = (
            text.embeddings.token_embedding,
            text.encoder.layers,
            text.final_layer_norm,
        )
        self.register_buffer("table", text.embeddings.position_embedding.weight.detach())
        self.head = text.head

    def forward(self, tokens: Tensor) -> Tensor:
        x = self.tokens(tokens) + self.table
        for layer in self.layers:
            x = clip_block(layer, x)
        return self.head(self.norm(x)[:, -1])


class DinoPatches(nn.Module):
    """Patch features (B, h, w, C) of DINO or DINOv2, after the last norm."""

    def __init__(self, model: nn.Module):
        super().__init__()
        own = model.embeddings
        self.patches = own.patch_embeddings.projection
        self.layers = model.layers if hasattr(model, "layers") else model.encoder.layer
        self.norm = model.layernorm
        table = own.position_embeddings.detach()[0]
        self.grid = int((len(table) - 1) ** 0.5)
        registers = getattr(own, "register_tokens", None)
        self.antialias = registers is not None  # as in the training of those networks
        first = [own.cls_token.detach() + table[:1], *([] if registers is None else [registers.detach()])]
        self.register_buffer("first", torch.cat(first, dim=1))
        self.register_buffer("table", table[1:])

    @property
    def prefix(self) -> int:
        """Number of tokens before those of the patches."""
        return int(self.first.shape[1])

    def forward(self, image: Tensor) -> Tensor:
        x, grid = self.tokens(image)
        return x[:, self.prefix :].unflatten(1, grid)

    def tokens(self, image: Tensor) -> tuple[Tensor, tuple[int, int]]:
        """All tokens after the last norm, and the grid of the patches among them."""
        x = self.patches(image)
        height, width = x.shape[-2:]
        x = x.flatten(2).transpose(1, 2) + positions(self.table, self.grid, height, width, self.antialias)
        x = torch.cat((self.first.expand(x.shape[0], -1, -1), x), dim=1)
        for layer in self.layers:
            x = layer(x)
        return self.norm(x), (height, width)


class Dinov3Patches(DinoPatches):
    """Patch features (B, h, w, C) of DINOv3, which turns queries and keys by their patch's place in -1…1."""

    def __init__(self, model: nn.Module):
        nn.Module.__init__(self)
        own = model.embeddings
        self.patches, self.layers, self.norm = own.patch_embeddings, model.model.layer, model.norm
        self.register_buffer("first", torch.cat((own.cls_token, own.register_tokens), dim=1).detach())
        self.register_buffer("frequencies", 2 * torch.pi * model.rope_embeddings.inv_freq.detach())

    def tokens(self, image: Tensor) -> tuple[Tensor, tuple[int, int]]:
        """All tokens after the last norm, and the grid of the patches among them."""
        x = self.patches(image)
        height, width = x.shape[-2:]
        places = torch.meshgrid(
            *(2 * (torch.arange(n, device=x.device) + 0.5) / n - 1 for n in (height, width)), indexing="ij"
        )
        angles = torch.stack([place.flatten() for place in places], dim=-1)[..., None] * self.frequencies
        angles = angles.flatten(1).tile(2)
        x = torch.cat((self.first.expand(x.shape[0], -1, -1), x.flatten(2).transpose(1, 2)), dim=1)
        for layer in self.layers:
            x = layer(x, position_embeddings=(angles.cos(), angles.sin()))
        return self.norm(x), (height, width)


class Talk2DinoHead(nn.Module):
    """Maps CLIP's text embedding to DINOv2's patch space (Barsellotti et al., Talking to DINO, ICCV 2025)."""

    def __init__(self, weights: dict[str, Tensor]):
        super().__init__()
        for name in ("linear_layer", "linear_layer2"):
            weight = weights[f"{name}.weight"]
            layer = nn.Linear(weight.shape[1], weight.shape[0])
            layer.load_state_dict({"weight": weight, "bias": weights[f"{name}.bias"]})
            setattr(self, name, layer)

    def forward(self, x: Tensor) -> Tensor:
        return self.linear_layer2(torch.tanh(self.linear_layer(x)))


class SamImage(nn.Module):
    """SAM's image encoder, and the mean over heads of its last block's attention."""

    def __init__(self, model: nn.Module):
        super().__init__()
        self.own = model.vision_encoder

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        own = self.own
        x = own.patch_embed(image)
        if own.pos_embed is not None:
            x = x + own.pos_embed
        for layer in own.layers[:-1]:
            x = layer(x)
        last = own.layers[-1]  # it attends to the whole image
        mixed, weights = last.attn(last.layer_norm1(x))
        x = x + mixed
        x = x + last.mlp(last.layer_norm2(x))
        heads = last.attn.num_attention_heads
        return own.neck(x), weights.reshape(image.shape[0], heads, *weights.shape[-2:]).mean(dim=1)


class SamMasks(nn.Module):
    """SAM's mask decoder with point prompts, one mask set for each point."""

    def __init__(self, model: nn.Module):
        super().__init__()
        self.prompts, self.decoder = model.prompt_encoder, model.mask_decoder
        with torch.no_grad():
            self.register_buffer("where", model.get_image_wide_positional_embeddings())

    def forward(self, features: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        prompts = points[:, :, None]
        labels = torch.ones_like(prompts[..., 0]).to(torch.int64)
        sparse, dense = self.prompts(input_points=prompts, input_labels=labels, input_boxes=None, input_masks=None)
        found = self.decoder(
            image_embeddings=features, image_positional_embeddings=self.where, sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense, multimask_output=True,
        )  # fmt: skip
        return found[0], found[1]
