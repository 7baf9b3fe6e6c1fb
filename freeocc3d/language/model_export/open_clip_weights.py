"""Transfers the weights of OpenCLIP's (and OpenAI's) CLIP to transformers' CLIP."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

_ONCE = {
    "vision_model.embeddings.class_embedding": "visual.class_embedding",
    "vision_model.embeddings.patch_embedding.weight": "visual.conv1.weight",
    "vision_model.embeddings.position_embedding.weight": "visual.positional_embedding",
    "text_model.embeddings.token_embedding.weight": "token_embedding.weight",
    "text_model.embeddings.position_embedding.weight": "positional_embedding",
}
"""Weights outside the blocks: transformers' name -> OpenCLIP's."""

_LAYERS = {
    "vision_model.pre_layrnorm": "visual.ln_pre",
    "vision_model.post_layernorm": "visual.ln_post",
    "text_model.final_layer_norm": "ln_final",
}
"""Layers outside the blocks, each with a weight and a bias."""

_BLOCK_LAYERS = {
    "layer_norm1": "ln_1",
    "layer_norm2": "ln_2",
    "self_attn.out_proj": "attn.out_proj",
    "mlp.fc1": "mlp.c_fc",
    "mlp.fc2": "mlp.c_proj",
}
"""Layers of each block."""


def clip_from_open_clip(state: dict[str, Tensor], config: dict[str, Any]) -> nn.Module:
    """Makes transformers' CLIPModel with the weights of an OpenCLIP (or OpenAI) ViT.

    state: OpenCLIP's weights by name.  config: its ``model_cfg``.
    Raises KeyError or RuntimeError if the weights do not belong to such a network.
    """
    from transformers import CLIPModel

    model = CLIPModel(_configuration(config))
    weights = {"logit_scale": state["logit_scale"], "visual_projection.weight": state["visual.proj"].T}
    weights |= _tower(state, "vision_model", "visual.transformer.resblocks", config["vision_cfg"]["layers"])
    weights |= _tower(state, "text_model", "transformer.resblocks", config["text_cfg"]["layers"])
    weights["text_projection.weight"] = state["text_projection"].T
    model.load_state_dict({name: value.contiguous() for name, value in weights.items()}, strict=True)
    return model.eval()


def clip_text_from_open_clip(state: dict[str, Tensor], heads: int) -> nn.Module:
    """Makes transformers' CLIPTextModelWithProjection with the text tower of an OpenCLIP ViT, and GELU.

    state: the weights by OpenCLIP's names.  heads: of its attention.
    Raises KeyError or RuntimeError if the weights do not belong to such a tower.
    """
    from transformers import CLIPTextConfig, CLIPTextModelWithProjection

    tokens, width = state["token_embedding.weight"].shape
    layers = len({name.split(".")[2] for name in state if name.startswith("transformer.resblocks.")})
    config = CLIPTextConfig(
        hidden_size=width, num_hidden_layers=layers, num_attention_heads=heads, hidden_act="gelu", vocab_size=tokens,
        intermediate_size=len(state["transformer.resblocks.0.mlp.c_fc.weight"]),
        max_position_embeddings=len(state["positional_embedding"]), projection_dim=state["text_projection"].shape[1],
        eos_token_id=tokens - 1, bos_token_id=tokens - 2, pad_token_id=tokens - 1,
    )  # fmt: skip
    weights = _tower(state, "text_model", "transformer.resblocks", layers)
    weights["text_projection.weight"] = state["text_projection"].T
    model = CLIPTextModelWithProjection(config)
    model.load_state_dict({name: value.contiguous() for name, value in weights.items()}, strict=True)
    return model.eval()


def _tower(state: dict[str, Tensor], tower: str, blocks: str, count: int) -> dict[str, Tensor]:
    """The weights of a tower by transformers' names, all but its projection."""
    weights = {ours: state[theirs] for ours, theirs in _ONCE.items() if ours.startswith(tower)}
    layers = {ours: theirs for ours, theirs in _LAYERS.items() if ours.startswith(tower)}
    for n in range(count):
        theirs, ours = f"{blocks}.{n}", f"{tower}.encoder.layers.{n}"
        layers |= {f"{ours}.{name}": f"{theirs}.{their_name}" for name, their_name in _BLOCK_LAYERS.items()}
        for kind in ("weight", "bias"):
            parts = state[f"{theirs}.attn.in_proj_{kind}"].chunk(3)
            for letter, part in zip("qkv", parts, strict=True):
                weights[f"{ours}.self_attn.{letter}_proj.{kind}"] = part
    for ours, theirs in layers.items():
        weights |= {f"{ours}.{kind}": state[f"{theirs}.{kind}"] for kind in ("weight", "bias")}
    return weights


def _configuration(config: dict[str, Any]) -> Any:
    """transformers' CLIPConfig for an OpenCLIP ``model_cfg``."""
    from transformers import CLIPConfig

    vision, text, dimension = config["vision_cfg"], config["text_cfg"], config["embed_dim"]
    act = "quick_gelu" if config.get("quick_gelu") else "gelu"
    tokens = text["vocab_size"]
    return CLIPConfig(
        projection_dim=dimension,
        vision_config={
            "hidden_size": vision["width"], "num_hidden_layers": vision["layers"], "hidden_act": act,
            "num_attention_heads": vision["width"] // vision.get("head_width", 64),
            "intermediate_size": int(vision["width"] * vision.get("mlp_ratio", 4)),
            "image_size": vision["image_size"], "patch_size": vision["patch_size"], "projection_dim": dimension,
        },
        text_config={
            "hidden_size": text["width"], "num_hidden_layers": text["layers"], "hidden_act": act,
            "num_attention_heads": text["heads"], "intermediate_size": 4 * text["width"], "vocab_size": tokens,
            "max_position_embeddings": text["context_length"], "projection_dim": dimension,
            "eos_token_id": tokens - 1, "bos_token_id": tokens - 2, "pad_token_id": tokens - 1,
        },
    )  # fmt: skip
