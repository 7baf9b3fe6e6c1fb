"""Model packages: folders with a manifest, networks as ONNX files and a tokenizer, from which encoders are made.

    manifest.yaml (or .json)   what the package is, its parts, and the sha256 of every file
    image.onnx  head.onnx  text.onnx  tokenizer.json   … by kind, see ``KINDS``

``freeocc3d models`` exports checkpoints as packages, and fetches, lists and verifies packages. Packages are in the
models folder (the environment variable FREEOCC3D_MODELS, else ~/.cache/freeocc3d/models) or anywhere else. Nothing in a
package is ever unpickled.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from ..core.errors import ModelError
from ..core.onnx_session import Network, load_network
from ..core.regular_files import open_regular, read_text
from ..core.typed_documents import InvalidDocument, as_type, parse_json
from ..core.yaml_documents import parse_yaml
from ..settings.registry import nearest

MANIFESTS = ("manifest.yaml", "manifest.json")
FORMAT = 1
_WEIGHTS = ".onnx.data"
SUFFIXES = (".onnx", ".safetensors", ".json", ".yaml", _WEIGHTS)
"""Suffixes of the files that a package may contain. Weights that a network keeps beside it are no part of
their own."""
Precision = Literal["fp32", "fp16", "int8"]
"""Precision of a package's weights."""

_LARGEST_MANIFEST = 1 << 20
_CHUNK = 1 << 20
_LONGEST_NAME = 200
_LEAST_STD, _MOST_LEVEL = 1e-3, 1000.0


@dataclass(frozen=True)
class Graph:
    """Names of the required inputs and outputs of a part of a package; it may have more outputs."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


_TEXT = Graph(("tokens",), ("features",))

KINDS: dict[str, dict[str, Graph]] = {
    "clip": {
        "image": Graph(("image",), ("queries", "keys", "values", "stream")),
        "head": Graph(("mixed", "stream"), ("features", "reduced", "pooled")),
        "text": _TEXT,
    },
    "windows": {"image": Graph(("image",), ("pooled",)), "text": _TEXT},
    "dense": {"image": Graph(("image",), ("features",)), "text": _TEXT},
    "masks": {"image": Graph(("image",), ("masks", "embeddings")), "text": _TEXT},
    "backbone": {"image": Graph(("image",), ("features",))},
    "sam": {
        "image": Graph(("image",), ("features", "attention")),
        "masks": Graph(("features", "points"), ("masks", "scores")),
    },
    "prompts": {
        "image": Graph(("image",), ("features",)),
        "masks": Graph(("features", "points"), ("masks", "scores")),
    },
}
"""Kind of package -> its networks. B images of H x W pixels; N = prefix tokens + h w patches, row by row.

clip (CLIP and SigLIP): ``image`` (B, 3, H, W), normalized, runs up to the last block, and returns that block's
``queries``, ``keys`` and ``values``, each (B, heads, N, d), and its residual ``stream`` (B, N, heads d). Attention
mixes the values to ``mixed`` (B, N, heads d), the input of ``head``, which returns ``features`` (B, N, D) with the
block's residual and feed-forward part, ``reduced`` (B, N, D) without both, and ``pooled`` (B, D), the embedding of the
whole image. ``text``: ``tokens`` (T, L) int64 to ``features`` (T, D).
windows: ``pooled`` (B, D) alone, for images of the size of the training's.
dense: patch ``features`` (B, h, w, D) that are already in the text's space.
masks: ``masks`` (B, Q, h, w) logits and ``embeddings`` (B, Q, D) in the text's space.
backbone: patch ``features`` (B, h, w, C) in their own space.
sam: ``features`` (B, C, h, w) and the last block's ``attention`` (B, h w, h w), mean over heads; ``masks`` takes
``points`` (B, P, 2), x and y in the pixels of the input, and gives for each ``masks`` (B, P, 3, 4 h, 4 w) logits and
``scores`` (B, P, 3), the network's own estimates of their IoU.
prompts: the same for one image, without attention and with ``features`` (1, n) that only ``masks`` reads.
"""


@dataclass(frozen=True)
class Package:
    """A model package with a complete manifest.

    parts: part ("image", "text", "tokenizer"…) -> file name.  files: file name -> sha256.  dimension: D of features.
    mean, std: (3,) of RGB in 0…1.  patch: edge of a patch in pixels.  input_size: edge of the training images in
    pixels.  prefix_tokens: number of tokens before those of the patches.  logit_scale: factor of the cosines in
    training, one over the softmax temperature.  stretched: whether a square input shows the whole image stretched, as
    SAM 2 expects it; otherwise the image is at the upper left.
    """

    folder: Path
    name: str
    kind: str
    dimension: int
    precision: str
    licence: str
    source: str
    mean: tuple[float, ...]
    std: tuple[float, ...]
    patch: int
    input_size: int
    prefix_tokens: int
    logit_scale: float
    parts: Mapping[str, str]
    files: Mapping[str, str]
    stretched: bool = False

    @property
    def bytes(self) -> int:
        """Total size of its files."""
        return sum((self.folder / name).stat().st_size for name in self.files)

    @property
    def text_sha256(self) -> str:
        """Identifies the text part: a hash of the hashes of the text network, the tokenizer, and weights beside it."""
        names = self.parts["text"], self.parts["tokenizer"], f"{self.parts['text']}.data"
        own = "".join(self.files[name] for name in names if name in self.files)
        return hashlib.sha256(own.encode()).hexdigest()

    def file(self, part: str) -> Path:
        """The part's file, after a check of its content. Raises ModelError."""
        return self.checked(self.parts[part])

    def checked(self, name: str) -> Path:
        """A file of the package, after a check of its content. Raises ModelError."""
        path, stated = self.folder / name, self.files[name]
        found = hash_file(path)
        if found != stated:
            raise ModelError(
                f"{path} is damaged: its sha256 is {found[:12]}…, but the manifest states {stated[:12]}…. Pull or "
                "export the model again."
            )
        return path

    def _checked_weights(self, name: str) -> bool:
        """Whether a network may keep weights in a file of that name, whose content is then checked. Raises
        ModelError."""
        return name.endswith(_WEIGHTS) and name in self.files and self.checked(name).is_file()

    def session(self, part: str, device: str = "cpu") -> Network:
        """The part's network, after a check of its files, inputs, outputs and dimension. Raises ModelError."""
        path = self.file(part)
        network = load_network(path, device, self._checked_weights)
        expected, outputs = KINDS[self.kind][part], network.outputs
        if sorted(network.inputs) != sorted(expected.inputs) or set(expected.outputs) - set(outputs):
            raise ModelError(
                f"{path} takes {', '.join(network.inputs)} and gives {', '.join(outputs)}, but the {part} network of a "
                f"'{self.kind}' model takes {', '.join(expected.inputs)} and gives {', '.join(expected.outputs)}. "
                "Export it again with 'freeocc3d models export'."
            )
        for name in ("features", "reduced", "pooled", "embeddings") if "text" in self.parts else ():
            if part == "image" and self.kind == "clip":
                continue  # not yet in the text's space
            last = (outputs.get(name) or [None])[-1]
            if isinstance(last, int) and last != self.dimension:
                raise ModelError(
                    f"{path} gives {name} of {last} dimensions, but the manifest states {self.dimension}: export the "
                    "image and text networks from one model."
                )
        return network


def find_models_folder() -> Path:
    """The folder in which packages are found by name."""
    given = os.environ.get("FREEOCC3D_MODELS")
    return Path(given) if given else Path.home() / ".cache" / "freeocc3d" / "models"


def find_model(model: str, kinds: tuple[str, ...], option: str) -> Package:
    """Finds the package of one of ``kinds`` in the folder ``model``, or with that name in the models folder. ``option``
    is the key that selected it. Raises ModelError."""
    if not model:
        raise ModelError(
            f"{option} is empty: set it to the folder of a model, or to its name ({_known()}). 'freeocc3d models "
            "export' makes models, 'freeocc3d models pull' fetches them."
        )
    folder = Path(model).expanduser()
    if not folder.is_dir():
        if folder.name != model or not (find_models_folder() / model).is_dir():
            close = nearest(model, (path.name for path in _folders()))
            raise ModelError(f"There is no model '{model}'{close}, neither as a folder nor by name ({_known()}).")
        folder = find_models_folder() / model
    package = read_package(folder)
    if package.kind not in kinds:
        raise ModelError(
            f"{option} needs a model of kind {' or '.join(kinds)}, but {folder} is of kind {package.kind}."
        )
    return package


def find_text_model(name: str, folder: str, text_sha256: str) -> Package:
    """Finds the package with that text part: in ``folder``, by its name, or under any name. Raises ModelError."""
    for candidate in (Path(folder), find_models_folder() / Path(name).name, *_folders()):
        try:
            package = read_package(candidate)
        except ModelError:
            continue
        if "text" in package.parts and package.text_sha256 == text_sha256:
            return package
    raise ModelError(
        f"The words of this map need the text part of the model '{name}' ({text_sha256[:12]}…), but it is neither in "
        f"{folder} nor in {find_models_folder()}. Copy its folder there, or give the map the words of another model "
        "with 'freeocc3d relabel'."
    )


def list_installed() -> dict[str, Package | ModelError]:
    """Name -> package in the models folder, or the error in it."""
    found: dict[str, Package | ModelError] = {}
    for folder in _folders():
        try:
            found[folder.name] = read_package(folder)
        except ModelError as error:
            found[folder.name] = error
    return found


def verify_files(package: Package) -> None:
    """Compares every file's content with the manifest's hash. Raises ModelError for the first that differs."""
    for name in package.files:
        package.checked(name)


def read_package(folder: Path) -> Package:
    """Reads the package in a folder: checks its manifest and that its files exist, but not yet their content.

    Raises ModelError.
    """
    if not folder.is_dir():
        raise ModelError(f"The model folder {folder} does not exist.")
    path = next((folder / name for name in MANIFESTS if (folder / name).exists()), None)
    if path is None:
        raise ModelError(
            f"{folder} is not a model package: it has no {MANIFESTS[0]}. 'freeocc3d models export' writes one."
        )
    package = parse_manifest(load_manifest(path), folder, path)
    for name in package.files:
        if not (folder / name).is_file():
            raise ModelError(f"The model {folder} lacks its file {name}: pull or export it again.")
    return package


def load_manifest(path: Path) -> Any:
    """The content of a manifest file. Raises ModelError."""
    try:
        text = read_text(path, _LARGEST_MANIFEST)
        return parse_json(text) if path.suffix == ".json" else parse_yaml(text)
    except OSError as error:
        raise ModelError(f"Cannot read {path}: {error.strerror}.") from error
    except ValueError as error:  # no text, JSON or YAML
        raise ModelError(f"Cannot read {path}: {' '.join(str(error).split())}.") from error


class _Manifest(msgspec.Struct):
    """The content of a manifest, see ``Package``."""

    name: Annotated[str, Meta(min_length=1, max_length=200)]
    kind: str
    dimension: Annotated[int, Meta(ge=1, le=1 << 16)]
    precision: Annotated[str, Meta(max_length=200)]
    licence: Annotated[str, Meta(max_length=1000)]
    source: Annotated[str, Meta(max_length=1000)]
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    patch: Annotated[int, Meta(ge=1, le=1024)]
    input_size: Annotated[int, Meta(ge=1, le=1 << 14)]
    parts: dict[str, str]
    files: dict[str, str]
    prefix_tokens: Annotated[int, Meta(ge=0, le=1024)] = 0
    logit_scale: Annotated[float, Meta(ge=1e-3, le=1e6)] = 100.0
    stretched: bool = False


def parse_manifest(manifest: Any, folder: Path, path: Path) -> Package:
    """The package that a manifest describes; errors name ``path``. Raises ModelError."""
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT or isinstance(manifest["format"], bool):
        raise ModelError(f"{path} is not a usable manifest: it must contain format: {FORMAT}.")
    try:
        said = as_type(manifest, _Manifest)
        _check_parts(said)
        numbers = *said.mean, *said.std, said.logit_scale
        if not all(map(math.isfinite, numbers)):
            raise InvalidDocument("its numbers must be finite")
        if min(said.std) < _LEAST_STD or max(map(abs, numbers[:-1])) > _MOST_LEVEL:
            raise InvalidDocument(
                f"'mean' and 'std' must be at most {_MOST_LEVEL:g}, and 'std' at least {_LEAST_STD:g}"
            )
        if said.input_size < said.patch:
            raise InvalidDocument("'input_size' must not be less than 'patch'")
    except InvalidDocument as error:
        raise ModelError(f"{path} is not a usable manifest: {error}.") from error
    return Package(folder=folder, **msgspec.structs.asdict(said))


def _check_parts(said: _Manifest) -> None:
    """Raises InvalidDocument for parts and files that are not those of the kind, or no plain files."""
    if said.kind not in KINDS:
        raise InvalidDocument(f"kind '{said.kind[:80]}' is not one of {', '.join(KINDS)}")
    needed = {*KINDS[said.kind], *(["tokenizer"] if "text" in KINDS[said.kind] else [])}
    if lacking := sorted(needed - set(said.parts)):
        raise InvalidDocument(f"'parts' lacks {', '.join(lacking)}")
    for name, digest in said.files.items():
        if not is_plain_name(name):
            raise InvalidDocument(f"'{shorten_name(name)}' is not the plain name of a file in its folder")
        if not name.endswith(SUFFIXES):
            raise InvalidDocument(f"'{name}' does not end with {', '.join(SUFFIXES)}")
        if len(digest) != 64 or set(digest) - set("0123456789abcdef"):
            raise InvalidDocument(f"the sha256 of '{name}' is not 64 hexadecimal digits")
    if sorted(said.parts.values()) != sorted(name for name in said.files if not name.endswith(_WEIGHTS)):
        raise InvalidDocument("'parts' and 'files' must name the same files")


def is_plain_name(name: str) -> bool:
    """Whether a name from elsewhere is that of a file in a folder, and nothing else."""
    return Path(name).name == name and not name.startswith(".") and "\\" not in name and _is_short(name)


def shorten_name(name: str) -> str:
    """A name from elsewhere, for a message."""
    return name if _is_short(name) else repr(name[:80])[1:-1]


def _is_short(name: str) -> bool:
    return len(name) <= _LONGEST_NAME and name.isprintable()


def hash_file(path: Path, digest: Any = None) -> str:
    """Hexadecimal digest of a file's content: of SHA-256, or of a digest that holds what comes before. Raises
    ModelError."""
    digest = hashlib.sha256() if digest is None else digest
    try:
        with open_regular(path) as stream:
            while chunk := stream.read(_CHUNK):
                digest.update(chunk)
    except OSError as error:
        raise ModelError(f"Cannot read {path}: {error.strerror}.") from error
    return str(digest.hexdigest())


def _folders() -> list[Path]:
    root = find_models_folder()
    if not root.is_dir():
        return []
    return sorted(p for p in root.iterdir() if p.is_dir() and not p.name.startswith(".") and p.suffix != ".partial")


def _known() -> str:
    names = ", ".join(path.name for path in _folders())
    return f"{find_models_folder()} contains: {names}" if names else f"{find_models_folder()} contains none yet"
