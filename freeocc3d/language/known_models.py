"""Models on the Hugging Face hub that have a short name, and what is known of them before they are fetched."""

from __future__ import annotations

from dataclasses import dataclass

from .model_packages import Precision

WORDS, MASKS = "words", "masks"
RECOMMENDED = {WORDS: "clip-b16", MASKS: "slimsam"}
"""What a model is for -> the recommended one: that with which the papers of training-free dense features report, and
the smallest SAM."""


@dataclass(frozen=True)
class KnownModel:
    """A repository of the hub.

    export: whether it is a ready-made ONNX export, of which a package is made without torch; else it is a checkpoint
    that ``freeocc3d models export`` accepts.  megabytes: to fetch, in its precision.  dimension: of features.
    gigaflop: multiplications and additions for a frame of 640 x 480 pixels at the encoder's default options.  variant:
    folder of the graphs and their configuration below ``onnx/``, in a repository of several models.
    """

    repository: str
    export: bool
    megabytes: int
    licence: str
    dimension: int
    gigaflop: int
    precision: Precision = "int8"
    variant: str = ""


KNOWN = {
    "clip-b16": KnownModel("Xenova/clip-vit-base-patch16", True, 152, "mit", 512, 211),
    "clip-b32": KnownModel("Xenova/clip-vit-base-patch32", True, 154, "mit", 512, 52),
    "siglip-b16": KnownModel("Xenova/siglip-base-patch16-224", True, 206, "apache-2.0", 768, 210),
    "siglip2-b16": KnownModel("onnx-community/siglip2-base-patch16-224-ONNX", True, 411, "apache-2.0", 768, 210),
    "mobileclip-s2": KnownModel("Xenova/mobileclip_s2", True, 199, "apple-ascl", 512, 80, "fp16"),
    "mobileclip2-s2": KnownModel("plhery/mobileclip2-onnx", True, 397, "apple-amlr", 512, 80, "fp32", "s2"),
    "clip-b16-openai": KnownModel("timm/vit_base_patch16_clip_224.openai", False, 599, "apache-2.0", 512, 211, "fp32"),
    "clip-b16-laion": KnownModel("laion/CLIP-ViT-B-16-laion2B-s34B-b88K", False, 599, "mit", 512, 211, "fp32"),
    "siglip-b16-google": KnownModel("google/siglip-base-patch16-224", False, 813, "apache-2.0", 768, 210, "fp32"),
    "siglip2-b16-naflex": KnownModel("google/siglip2-base-patch16-naflex", False, 1500, "apache-2.0", 768, 278, "fp32"),
    "slimsam": KnownModel("Xenova/slimsam-77-uniform", True, 40, "apache-2.0", 256, 75, "fp32"),
    "sam2-tiny": KnownModel("onnx-community/sam2.1-hiera-tiny-ONNX", True, 156, "apache-2.0", 256, 75, "fp32"),
    "dino-b16": KnownModel("facebook/dino-vitb16", False, 343, "apache-2.0", 768, 211, "fp32"),
    "dinov2-b14": KnownModel("facebook/dinov2-base", False, 346, "apache-2.0", 768, 306, "fp32"),
    "sam-b": KnownModel("facebook/sam-vit-base", False, 375, "apache-2.0", 256, 742, "fp32"),
}
"""Short name -> model. Sizes follow from the numbers of weights. MobileCLIP is fetched in fp16, because its users
report that its int8 export recognizes next to nothing."""

NAMES = {name: known.repository for name, known in KNOWN.items()}
