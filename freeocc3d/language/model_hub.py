"""Fetches model packages, ready-made ONNX exports to make packages of, or checkpoints to export, from the Hugging Face
hub.

Every file is compared with the hub's hash before it gets its name. An interrupted download continues where it stopped.
A package is fetched completely or not at all. Only ONNX, safetensors, JSON, YAML and plain text are fetched. The
environment variable HF_ENDPOINT selects another hub, and FREEOCC3D_OFFLINE=1 none.

Not by huggingface_hub (2.4.0 was tried): without its Xet protocol it keeps content of the right size and a wrong hash;
when a pull fails it deletes what was fetched, so the next one starts over; and without a network it tries for 23 s.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import urllib.request
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any
from urllib.parse import quote, urlsplit

import msgspec

from ..core.errors import ModelError
from ..core.progress import Progress
from ..core.regular_files import check_regular
from . import model_packages
from .known_models import KNOWN, NAMES, RECOMMENDED
from .ready_made import export_layout
from .timed_requests import Answer, NoAnswer, fetch
from .vision_server import shorten_to_line

OFFLINE = "FREEOCC3D_OFFLINE"
"""Environment variable that forbids to fetch anything."""

CHECKPOINTS = ".checkpoints"
"""Subfolder of the models folder for what is not yet a package."""

_CONFIGS = ("config.json", "open_clip_config.json", "preprocessor_config.json", "README.md")
_WEIGHTS = ("open_clip_model.safetensors", "model.safetensors")
_PARTS = re.compile(r"model-\d+-of-\d+\.safetensors|model\.safetensors\.index\.json")
"""Names of weights in several files, and of the list of what is in which."""
_TIMEOUT_S = 15.0
"""Time for a listing, and for each ``_LEAST_BYTES`` of a file."""
_LEAST_BYTES = 1 << 14
_LARGEST_LISTING = 16 << 20
_LARGEST = 1 << 40
"""Bytes of the largest file."""
_ATTEMPTS = 5
_PARTIAL, _FORBIDDEN = 206, 403
"""The status of an answer with the rest of a file, and of one to a user who has not accepted the repository's terms."""


@dataclass(frozen=True)
class _Remote:
    """A file on the hub: its path there, the name that it gets here, its size in bytes, and its sha256, or otherwise
    the sha1 of its git blob."""

    path: str
    name: str
    size: int
    sha256: str | None
    blob: str | None

    @property
    def identity(self) -> str:
        return (self.sha256 or self.blob or "")[:12]

    def is_content_of(self, path: Path) -> bool:
        if path.is_symlink() or check_regular(path).st_size != self.size:
            return False
        if self.sha256:
            return model_packages.hash_file(path) == self.sha256
        start = hashlib.sha1(b"blob %d\0" % self.size, usedforsecurity=False)
        return model_packages.hash_file(path, start) == self.blob


def pull_package(
    name: str,
    revision: str = "main",
    progress: Progress | None = None,
    precision: model_packages.Precision | None = None,
) -> Path:
    """Fetches the repository OWNER/NAME, or one of NAMES ("words" and "masks" are the recommended ones), and returns
    its folder: for a package, the one with its name in the models folder; for a checkpoint, one in the subfolder
    CHECKPOINTS. Complete files are not fetched again. precision: of a ready-made export; None = the one that suits a
    known model, and else int8, or the first that exists.

    Raises ModelError if the network fails, the repository does not exist or has no usable files, or a hash differs;
    DependencyError if a package is missing that reads an export.
    """
    progress = progress or Progress()
    name = RECOMMENDED.get(name, name)
    repository = NAMES.get(name, name)
    if not is_repository(name):
        raise unknown_name(name)
    local = local_name(name) + (f"-{precision}" if precision else "")
    if precision is None and (known := KNOWN.get(name)) and known.export and known.precision != "int8":
        precision = known.precision
    if is_offline():
        raise ModelError(
            f"{repository} is not fetched, because {OFFLINE} is set: unset it, or copy the model's folder."
        )
    remote = _listed(repository, revision, KNOWN[name].variant if name in KNOWN else "")
    manifest = next((remote[n] for n in model_packages.MANIFESTS if n in remote), None)
    sizes = {file: own.size for file, own in remote.items()}
    exported = None if manifest else export_layout.choose_files(repository, sizes, precision)
    root = model_packages.find_models_folder()
    root = root if manifest or exported else root / CHECKPOINTS
    target, partial = root / local, root / f"{local}.partial"
    if target.exists():
        if manifest or exported:
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
            wanted = exported[1] if exported else _checkpoint_files(repository, remote)
        if lacking := [file for file in wanted if file not in remote]:
            raise ModelError(f"{repository} lacks files of its manifest: {', '.join(lacking)}.")
        if exported:
            _check_space([remote[file] for file in wanted], partial, repository)
        for file in wanted:
            _fetch(repository, revision, remote[file], partial, progress)
        if exported:
            _make_package(partial, target, repository, exported[0], progress)
            return target
        if manifest:
            model_packages.verify_files(model_packages.read_package(partial))
        for rest in partial.glob("*.incomplete"):  # from another revision
            rest.unlink()
        partial.rename(target)
    except OSError as error:
        raise ModelError(f"Cannot write to {error.filename or partial}: {error.strerror}.") from error
    return target


def is_repository(name: str) -> bool:
    """Whether a name stands for a repository of the hub: a short one, or OWNER/NAME."""
    return name in RECOMMENDED or name in NAMES or re.fullmatch(r"\w[\w.-]*/\w[\w.-]*", name) is not None


def unknown_name(name: str) -> ModelError:
    """The error for a name that is no repository."""
    return ModelError(
        f"'{name}' is neither an installed model nor a repository OWNER/NAME of the hub"
        f"{model_packages.nearest(name, (*RECOMMENDED, *NAMES))}. Short names are {', '.join((*RECOMMENDED, *NAMES))}."
    )


def local_name(name: str) -> str:
    """The name of a repository's folder in the models folder."""
    name = RECOMMENDED.get(name, name)
    return name.split("/")[1] if name not in NAMES and is_repository(name) else name


def is_offline() -> bool:
    """Whether the user forbids to fetch anything."""
    return os.environ.get(OFFLINE, "") not in ("", "0")


def _check_space(files: Iterable[_Remote], folder: Path, repository: str) -> None:
    """Raises ModelError if the files do not fit beside a package that is made of them."""
    free = shutil.disk_usage(folder).free
    if (needed := 2 * sum(file.size for file in files)) > free:
        raise ModelError(
            f"{repository} needs {needed:,} bytes while its package is made, but {folder} has {free:,} free: make room."
        )


def _make_package(
    fetched: Path, target: Path, repository: str, precision: model_packages.Precision, progress: Progress
) -> None:
    """Makes the package of a fetched export, and removes what was fetched."""
    if (fetched / export_layout.graph_names(export_layout.MASK_GRAPHS, precision)[0]).exists():
        from .ready_made.mask_packages import package_of_mask_export

        progress.stage("joining points to the graph of masks")
        package_of_mask_export(fetched, target, repository, precision)
    else:
        from .ready_made.export_packages import package_of_export

        progress.stage("cutting the vision graph before its last attention")
        _, lacks = package_of_export(fetched, target, repository, precision)
        if lacks:
            progress.warn(lacks)
    shutil.rmtree(fetched)


def _checkpoint_files(repository: str, remote: dict[str, _Remote]) -> list[str]:
    """Names of the files of a checkpoint that an export needs. Raises ModelError if its weights are not safetensors."""
    weights = next(([file] for file in _WEIGHTS if file in remote), sorted(filter(_PARTS.fullmatch, remote)))
    if not weights:
        raise ModelError(
            f"{repository} has neither a model package ({model_packages.MANIFESTS[0]}) nor weights as safetensors. "
            "Other weights are not read, because they may run code."
        )
    words = ["tokenizer.json"] if "tokenizer.json" in remote else ["vocab.json", "merges.txt"]
    return [file for file in (*_CONFIGS, *words, *weights) if file in remote]


def _endpoint() -> str:
    return os.environ.get("HF_ENDPOINT", "https://huggingface.co").rstrip("/")


class _Sibling(msgspec.Struct):
    """A file as the hub lists it, see https://huggingface.co/docs/hub/api."""

    rfilename: str
    size: Annotated[int, msgspec.Meta(ge=0, le=_LARGEST)] | None = None
    blobId: str | None = None
    lfs: dict[str, Any] | None = None


class _Listing(msgspec.Struct):
    siblings: list[_Sibling] = []


def _listed(repository: str, revision: str, variant: str) -> dict[str, _Remote]:
    """The repository's files by name, without those in subfolders but ``export_layout.FOLDER``. Those of a variant are
    named as if the repository held nothing else. Raises ModelError."""
    url = f"{_endpoint()}/api/models/{repository}/revision/{quote(revision, safe='')}?blobs=true"
    received = bytearray()

    def receive(_: Answer, piece: bytes) -> None:
        received.extend(piece)
        if len(received) > _LARGEST_LISTING:
            raise NoAnswer("it lists more files than a repository has")

    try:
        answer = fetch(_request(url), receive, _TIMEOUT_S, redirects=True)
        if not answer.succeeded:
            raise _refused(answer.status, repository, revision)
        listing = msgspec.json.decode(received, type=_Listing)
    except (TimeoutError, NoAnswer, msgspec.MsgspecError, RecursionError) as error:
        raise _told(error, repository) from error
    remotes = [
        _Remote(path, own, file.size or 0, _digest((file.lfs or {}).get("sha256")), _digest(file.blobId))
        for file in sorted(listing.siblings, key=lambda file: file.rfilename.count("/"))
        if (own := _name_here(path := file.rfilename, variant)) is not None
    ]
    return {remote.name: remote for remote in remotes if remote.sha256 or remote.blob}


def _name_here(path: str, variant: str) -> str | None:
    """The name that a file of a repository gets; None for one that is not needed."""
    folder, slash, file = path.rpartition("/")
    graphs = f"{export_layout.FOLDER}{variant}/" if variant else export_layout.FOLDER
    if not model_packages.is_plain_name(file) or folder + slash not in ("", graphs):
        return None
    if folder and (".onnx" in file or not variant):
        return export_layout.FOLDER + file
    return file


def _digest(stated: object) -> str | None:
    """A hash that the hub states; None if it is none."""
    return stated if isinstance(stated, str) and re.fullmatch("[0-9a-f]{40}([0-9a-f]{24})?", stated) else None


def _fetch(repository: str, revision: str, remote: _Remote, folder: Path, progress: Progress) -> None:
    """Fetches one file into the folder; continues an earlier download of the same content."""
    path = folder / remote.name
    path.parent.mkdir(exist_ok=True)
    if path.exists() and remote.is_content_of(path):
        return
    progress.stage(f"{remote.name} ({remote.size / 1e6:.1f} MB)")
    incomplete = folder / f"{remote.name}.{remote.identity}.incomplete"
    free = shutil.disk_usage(folder).free
    if remote.size > free:
        raise ModelError(f"{remote.name} needs {remote.size:,} bytes, but {folder} has {free:,} free: make room.")
    if incomplete.is_symlink() or (incomplete.exists() and check_regular(incomplete).st_size > remote.size):
        incomplete.unlink()
    with incomplete.open("ab") as stream:
        for _ in range(_ATTEMPTS):  # a connection that breaks is taken up again, if it gave something
            if stream.tell() < remote.size:
                _continue(repository, revision, remote, stream)
    if incomplete.stat().st_size < remote.size:
        raise _told(NoAnswer("the connection breaks again and again"), repository)
    if not remote.is_content_of(incomplete):
        incomplete.unlink()
        raise ModelError(f"{remote.name} of {repository} does not match the hub's hash and was deleted: pull again.")
    incomplete.rename(path)


def _continue(repository: str, revision: str, remote: _Remote, stream: IO[bytes]) -> None:
    """Fetches the rest of a file, as far as the connection lasts. Raises ModelError."""
    start = stream.tell()
    request = _request(f"{_endpoint()}/{repository}/resolve/{quote(revision, safe='')}/{quote(remote.path)}")
    if start:
        request.add_header("Range", f"bytes={start}-")

    def receive(answer: Answer, piece: bytes) -> None:
        nonlocal start
        if start and answer.status != _PARTIAL:  # the server sends the whole file
            start = stream.seek(stream.truncate(0))
        if stream.tell() + len(piece) > remote.size:
            raise NoAnswer(f"it sends more than the {remote.size:,} bytes of {remote.name} that it lists")
        stream.write(piece)

    try:
        answer = fetch(request, receive, _TIMEOUT_S, least_bytes=_LEAST_BYTES, redirects=True)
    except (TimeoutError, NoAnswer) as error:
        if stream.tell() <= start:
            raise _told(error, repository) from error
        return
    if not answer.succeeded:
        raise _refused(answer.status, repository, revision)
    if stream.tell() <= start:
        raise _told(NoAnswer(f"it sends nothing of {remote.name}"), repository)


def _request(url: str) -> urllib.request.Request:
    """A request with the token of the user, if one is logged in. Raises ModelError."""
    if urlsplit(url).scheme not in ("http", "https") or not url.isascii() or not url.isprintable() or " " in url:
        raise ModelError(f"HF_ENDPOINT must be an address such as https://huggingface.co, not '{_endpoint()}'.")
    headers = {"User-Agent": "freeocc3d"}
    try:
        from huggingface_hub import get_token
    except ImportError:
        token = os.environ.get("HF_TOKEN")
    else:
        token = get_token()
    if token and token.isascii() and token.isprintable():
        headers["Authorization"] = f"Bearer {token}"
    return urllib.request.Request(url, headers=headers)


def _refused(status: int, repository: str, revision: str) -> ModelError:
    if status == _FORBIDDEN:
        return ModelError(
            f"{repository} is gated: accept its terms at {_endpoint()}/{repository}, and log in with 'hf auth login'."
        )
    if status in (401, 404):
        return ModelError(
            f"{_endpoint()} has no readable repository {repository} with revision {revision}: check its name, or log "
            "in with 'hf auth login'."
        )
    return ModelError(f"{_endpoint()} answered {status} to the request for {repository}: try again later.")


def _told(error: Exception, repository: str) -> ModelError:
    """Describes a failure on the way to the hub in one sentence."""
    said = shorten_to_line(str(error), 120)
    if isinstance(error, TimeoutError):
        said = f"it does not answer within {_TIMEOUT_S:g} s"
    elif isinstance(error, msgspec.MsgspecError | RecursionError):
        said = "it does not answer like a hub"
    return ModelError(
        f"Cannot fetch {repository} from {_endpoint()}: {said}. Fetched data are kept: pull again when the network "
        f"works, or copy the model's folder to {model_packages.find_models_folder()}."
    )
