"""Fetches model packages, or checkpoints to export, from the Hugging Face hub.

Every file is compared with the hub's hash before it gets its name. An interrupted download continues where it stopped.
A package is fetched completely or not at all. Only ONNX, safetensors, JSON, YAML and plain text are fetched. The
environment variable HF_ENDPOINT selects another hub.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import ModelError
from ..core.progress import Progress
from . import model_packages

NAMES = {
    "clip-b16-openai": "timm/vit_base_patch16_clip_224.openai",
    "clip-b16-laion": "laion/CLIP-ViT-B-16-laion2B-s34B-b88K",
    "siglip-b16": "google/siglip-base-patch16-224",
    "dino-b16": "facebook/dino-vitb16",
    "dinov2-b14": "facebook/dinov2-base",
    "sam-b": "facebook/sam-vit-base",
}
"""Short names of repositories whose checkpoints ``freeocc3d models export`` accepts."""

CHECKPOINTS = ".checkpoints"
"""Subfolder of the models folder for what is not yet a package."""

_CONFIGS = ("config.json", "open_clip_config.json", "preprocessor_config.json", "README.md")
_WEIGHTS = ("open_clip_model.safetensors", "model.safetensors")
_TIMEOUT_S = 15


@dataclass(frozen=True)
class _Remote:
    """A file on the hub: its size in bytes, and its sha256, or otherwise the sha1 of its git blob."""

    name: str
    size: int
    sha256: str | None
    blob: str | None

    @property
    def identity(self) -> str:
        return (self.sha256 or self.blob or "")[:12]

    def is_content_of(self, path: Path) -> bool:
        if self.sha256:
            return model_packages.hash_file(path) == self.sha256
        content = path.read_bytes()
        return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest() == self.blob


def pull_package(name: str, revision: str = "main", progress: Progress | None = None) -> Path:
    """Fetches the repository OWNER/NAME, or one of NAMES, and returns its folder: for a package, the one with its name
    in the models folder; for a checkpoint, one in the subfolder CHECKPOINTS. Complete files are not fetched again.

    Raises ModelError if the network fails, the repository does not exist or has no usable files, or a hash differs.
    """
    progress = progress or Progress()
    repository = NAMES.get(name, name)
    if not re.fullmatch(r"[\w.-]+/\w[\w.-]*", repository):
        raise ModelError(
            f"'{name}' is not a repository OWNER/NAME of the hub{model_packages.nearest(name, NAMES)}. "
            f"Short names are {', '.join(NAMES)}."
        )
    local = name if name in NAMES else repository.split("/")[1]
    remote = _listed(repository, revision)
    manifest = next((remote[n] for n in model_packages.MANIFESTS if n in remote), None)
    root = model_packages.find_models_folder() if manifest else model_packages.find_models_folder() / CHECKPOINTS
    target, partial = root / local, root / f"{local}.partial"
    if target.exists():
        if manifest:
            model_packages.verify_files(model_packages.read_package(target))
        return target
    try:
        partial.mkdir(parents=True, exist_ok=True)
        if manifest:
            _fetch(repository, revision, manifest, partial, progress)
            own = partial / manifest.name
            package = model_packages.parse_manifest(model_packages.load_manifest(own), partial, own)
            wanted = list(package.files)
        else:
            wanted = _checkpoint_files(repository, remote)
        if lacking := [file for file in wanted if file not in remote]:
            raise ModelError(f"{repository} lacks files of its manifest: {', '.join(lacking)}.")
        for file in wanted:
            _fetch(repository, revision, remote[file], partial, progress)
        if manifest:
            model_packages.verify_files(model_packages.read_package(partial))
        for rest in partial.glob("*.incomplete"):  # from another revision
            rest.unlink()
        partial.rename(target)
    except OSError as error:
        raise ModelError(f"Cannot write to {error.filename or partial}: {error.strerror}.") from error
    return target


def _checkpoint_files(repository: str, remote: dict[str, _Remote]) -> list[str]:
    """Names of the files of a checkpoint that an export needs. Raises ModelError if its weights are not safetensors."""
    weights = next((file for file in _WEIGHTS if file in remote), None)
    if weights is None:
        raise ModelError(
            f"{repository} has neither a model package ({model_packages.MANIFESTS[0]}) nor weights as safetensors. "
            "Other weights are not read, because they may run code."
        )
    words = ["tokenizer.json"] if "tokenizer.json" in remote else ["vocab.json", "merges.txt"]
    return [file for file in (*_CONFIGS, *words, weights) if file in remote]


def _endpoint() -> str:
    return os.environ.get("HF_ENDPOINT", "https://huggingface.co").rstrip("/")


def _listed(repository: str, revision: str) -> dict[str, _Remote]:
    """The repository's files by name, without those in subfolders."""
    hub = _library()
    try:
        info = hub.HfApi(endpoint=_endpoint()).model_info(
            repository, revision=revision, files_metadata=True, timeout=_TIMEOUT_S
        )
    except Exception as error:  # raised by the library's transport, which changes between versions
        raise _told(error, repository, revision) from error
    return {
        file.rfilename: _Remote(file.rfilename, file.size or 0, file.lfs.sha256 if file.lfs else None, file.blob_id)
        for file in info.siblings or []
        if Path(file.rfilename).name == file.rfilename and not file.rfilename.startswith(".")
    }


def _fetch(repository: str, revision: str, remote: _Remote, folder: Path, progress: Progress) -> None:
    """Fetches one file into the folder; continues an earlier download of the same content."""
    path = folder / remote.name
    if path.is_file() and remote.is_content_of(path):
        return
    progress.stage(f"{remote.name} ({remote.size / 1e6:.1f} MB)")
    hub = _library()
    from huggingface_hub.file_download import http_get
    from huggingface_hub.utils import build_hf_headers

    incomplete = folder / f"{remote.name}.{remote.identity}.incomplete"
    free = shutil.disk_usage(folder).free
    if remote.size > free:
        raise ModelError(f"{remote.name} needs {remote.size:,} bytes, but {folder} has {free:,} free: make room.")
    with incomplete.open("ab") as stream:
        done = stream.tell()
        if done > remote.size:
            done = 0
            stream.truncate(0)
        try:
            url = hub.hf_hub_url(repository, remote.name, revision=revision, endpoint=_endpoint())
            headers = build_hf_headers()
            if done < remote.size:
                http_get(url, stream, resume_size=done, headers=headers, expected_size=remote.size)
        except OSError as error:
            if error.filename is not None:  # an error of the disk, not of the network
                raise
            raise _told(error, repository, revision) from error
        except Exception as error:
            raise _told(error, repository, revision) from error
    if not remote.is_content_of(incomplete):
        incomplete.unlink()
        raise ModelError(f"{remote.name} of {repository} does not match the hub's hash and was deleted: pull again.")
    incomplete.rename(path)


def _library() -> Any:
    try:
        import huggingface_hub
        from huggingface_hub.utils import logging
    except ImportError as error:
        raise ModelError("Pulling models needs huggingface_hub: pip install 'freeocc3d[models]'.") from error
    logging.set_verbosity_error()  # this module reports the errors
    return huggingface_hub


def _told(error: Exception, repository: str, revision: str) -> ModelError:
    """Describes a failure on the way to the hub in one sentence."""
    status = getattr(getattr(error, "response", None), "status_code", None)
    if status in (401, 403, 404):
        return ModelError(
            f"{_endpoint()} has no readable repository {repository} with revision {revision}: check its name, or log "
            "in with 'hf auth login'."
        )
    if status is not None:
        return ModelError(f"{_endpoint()} answered {status} to the request for {repository}: try again later.")
    said = " ".join(str(error).split())[:120] or type(error).__name__
    return ModelError(
        f"Cannot fetch {repository} from {_endpoint()}: {said}. Fetched data are kept: pull again when the network "
        f"works, or copy the model's folder to {model_packages.find_models_folder()}."
    )
