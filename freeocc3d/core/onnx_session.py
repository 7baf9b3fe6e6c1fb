"""Loads and runs ONNX networks, which may come from anybody: what is wrong with one is a ModelError with its path."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import ConfigError, ModelError
from .onnx_files import find_external_files
from .regular_files import check_regular
from .threads import count_threads

_MOST_NUMBERS = 1 << 26
"""In the largest input that a network may state: an image of 4000 x 4000 pixels."""

Shape = tuple[int | None, ...]
"""The length of each axis; None = any."""


class Network:
    """A network in a file, with one thread per available processor.

    session: the onnxruntime ``InferenceSession``.  inputs, outputs: name -> stated shape; text and None for axes of any
    length.
    """

    def __init__(self, path: Path, session: Any):
        self.path, self.session = path, session
        self.inputs: dict[str, list[Any]] = {node.name: node.shape for node in session.get_inputs()}
        self.outputs: dict[str, list[Any]] = {node.name: node.shape for node in session.get_outputs()}
        for name, shape in self.inputs.items():
            sides = [side for side in shape if isinstance(side, int)]
            if min(sides, default=1) < 1 or math.prod(sides) > _MOST_NUMBERS:
                raise ModelError(f"{path} states an input '{name}' of {_shown(shape)}, which no image has.")

    def run(
        self,
        names: Sequence[str],
        feeds: Mapping[str, NDArray[Any]],
        shapes: Mapping[str, Shape] | None = None,
        finite: bool = True,
    ) -> list[NDArray[Any]]:
        """The outputs with these names. shapes: what they must have.  finite: whether NaN and infinity are refused.

        Raises ModelError if the network fails, or gives something else than numbers of these shapes.
        """
        try:
            given = self.session.run(list(names), dict(feeds))
        except Exception as error:  # onnxruntime's exceptions share no base class
            fed = ", ".join(f"{name} {_shown(array.shape)}" for name, array in feeds.items())
            raise ModelError(f"{self.path} fails on {fed}: {_said(error)}.") from error
        for name, array in zip(names, given, strict=True):
            if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
                raise ModelError(f"{self.path} gives something else than numbers as '{name}': export it again.")
            wanted = (shapes or {}).get(name)
            if wanted is not None and not _fits(array.shape, wanted):
                raise ModelError(
                    f"{self.path} gives '{name}' of {_shown(array.shape)} instead of {_shown(wanted)}: export it again."
                )
            if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
                raise ModelError(f"{self.path} gives numbers that are not finite as '{name}': export it again.")
        return list(given)


def load_network(path: Path, device: str = "cpu", external: Callable[[str], bool] = lambda name: True) -> Network:
    """The network in an ONNX file. device: "cpu" or "cuda:0".  external: whether a file beside it may hold its weights,
    by its name.

    Raises ModelError if the file is missing, not ONNX, or keeps weights elsewhere; ConfigError if onnxruntime lacks the
    device.
    """
    import onnxruntime as ort

    try:
        check_regular(path)
        _check_external(path, external)
    except OSError as error:
        raise ModelError(f"Cannot read the network {path}: {error.strerror}.") from error
    options = ort.SessionOptions()
    options.intra_op_num_threads = count_threads()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # NumPy and Numba run in between
    options.log_severity_level = 4
    providers: list[Any] = ["CPUExecutionProvider"]
    if device != "cpu":
        kind, _, number = device.partition(":")
        if kind != "cuda" or not (number or "0").isdecimal():
            raise ConfigError(f"'device' must be cpu or cuda:0, not '{device}'.")
        if "CUDAExecutionProvider" not in ort.get_available_providers():
            raise ConfigError(f"This onnxruntime does not run on {device}: pip install onnxruntime-gpu, or use cpu.")
        providers.insert(0, ("CUDAExecutionProvider", {"device_id": int(number or 0)}))
    try:
        session = ort.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime's exceptions share no base class
        raise ModelError(f"{path} is not an ONNX network that onnxruntime can run: {_said(error)}.") from error
    return Network(path, session)


def _check_external(path: Path, allowed: Callable[[str], bool]) -> None:
    """Raises ModelError if a network keeps weights in a file that is not allowed; OSError."""
    for name in find_external_files(path):
        plain = Path(name).name == name and name not in ("", ".", "..") and name.isprintable()
        if not plain or not allowed(name):
            why = "which its manifest does not list" if plain else "which is no file beside it"
            raise ModelError(f"{path} keeps weights in '{name[:80]}', {why}: export it again.")
        check_regular(path.parent / name)


def _fits(shape: tuple[int, ...], wanted: Shape) -> bool:
    return len(shape) == len(wanted) and all(want in (None, side) for side, want in zip(shape, wanted, strict=True))


def _shown(shape: Sequence[Any]) -> str:
    return f"({', '.join('any' if side is None else str(side) for side in shape)})"


def _said(error: Exception) -> str:
    return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
