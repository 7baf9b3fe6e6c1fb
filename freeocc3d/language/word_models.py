"""Which installed model understands words best, and how a configuration comes to use it."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from ..core.errors import ModelError
from ..settings.config import Settings
from . import known_models, model_hub, model_packages
from .model_packages import Package

AUTO = "auto"

ENCODERS = {"clip": "clip", "masks": "seem", "dense": "dinov2", "windows": "clip"}
"""Kind of package -> the encoder that runs it, the best first: a feature for each patch in the space in which the
network was trained, one for each mask, one through a head that was added, one for each window."""

_WITHOUT = (
    "Words: colors alone, because no model of any words is installed: 'freeocc3d models pull words' gets one, and "
    "'freeocc3d relabel' gives its words to a map."
)


def choose_encoder(settings: Settings) -> tuple[Settings, str]:
    """The settings with an encoder, and the reason for it, a sentence; an empty one if the settings name an encoder.

    "auto" is the model that the settings name for the encoder clip, else the best of the models folder, else color.
    """
    if settings.language.encoder != AUTO:
        return settings, ""
    if settings.given("language", "clip").get("model"):
        return settings.changed("language", encoder="clip"), ""
    package = find_best()
    if package is None:
        return settings.changed("language", encoder="color"), _WITHOUT
    settings = use_package(settings, package)
    return (
        settings,
        f"Words: the model {package.folder.name} ({settings.language.encoder}), the best that is installed.",
    )


def find_best() -> Package | None:
    """The best package of the models folder: the recommended one, if it is there; else by kind, in the order of
    ENCODERS, then the one with the smallest patches, then with the most dimensions. None if words cannot be encoded."""
    if find_spec("tokenizers") is None:
        return None
    kinds = list(ENCODERS)
    usable = [own for own in model_packages.list_installed().values() if isinstance(own, Package) and own.kind in kinds]

    def rank(own: Package) -> tuple[object, ...]:
        recommended = own.folder.name == known_models.RECOMMENDED[known_models.WORDS]
        return not recommended, kinds.index(own.kind), own.patch, -own.dimension, own.folder.name

    return min(usable, key=rank, default=None)


def use_package(settings: Settings, package: Package) -> Settings:
    """The settings with the encoder that runs a package. Raises ModelError for a package without words."""
    if package.kind not in ENCODERS:
        raise ModelError(f"{package.folder} is a model of kind {package.kind}, which understands no words.")
    inside = package.folder.parent == model_packages.find_models_folder()
    model = package.folder.name if inside else str(package.folder)
    return settings.changed("language", encoder=ENCODERS[package.kind]).with_backend("language", model=model)


def find_words(name: str) -> Package | None:
    """The installed model with a name, or in a folder; None if there is none, but one can be fetched. Raises
    ModelError."""
    local = model_hub.local_name(name)
    if Path(local).is_dir() or (model_packages.find_models_folder() / local).is_dir():
        return model_packages.find_model(local, tuple(ENCODERS), "--words")
    if not model_hub.is_repository(name):
        raise model_hub.unknown_name(name)
    return None
