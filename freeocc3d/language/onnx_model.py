"""Sessions of ONNX models, and what is wrong with a file that gives none."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import ConfigError, DependencyError

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


def load_session(path: Path, device: str = "cpu") -> InferenceSession:
    """A session of a model file; device: "cpu", or "cuda:0" and so on with an ONNX Runtime that has CUDA.

    Raises ConfigError: no such file, not an ONNX model, no such device; DependencyError: ONNX Runtime has no CUDA.
    """
    import onnxruntime

    kind, _, number = device.partition(":")
    if kind not in ("cpu", "cuda") or (number and not number.isdigit()):
        raise ConfigError(f"'{device}' is no device for a network: give cpu, or cuda:0 and so on.")
    if kind == "cuda" and "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        raise DependencyError(f"The ONNX Runtime that is installed cannot use {device}: pip install onnxruntime-gpu.")
    if not path.is_file():
        raise ConfigError(f"There is no network {path}: give the path of an ONNX file.")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # errors; the exception says the rest
    cuda = [("CUDAExecutionProvider", {"device_id": int(number or 0)})] if kind == "cuda" else []
    try:
        return onnxruntime.InferenceSession(path, options, [*cuda, "CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's are of many kinds, all of them directly below Exception
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"{path} cannot be used as an ONNX model: {reason}") from error
