"""Loads ONNX networks for onnxruntime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .errors import ConfigError, ModelError
from .threads import count_threads


def load_session(path: Path, device: str = "cpu") -> Any:
    """An onnxruntime ``InferenceSession`` with one thread per available processor. device: "cpu" or "cuda:0".

    Raises ModelError if the file is missing or not ONNX, ConfigError if onnxruntime lacks the device.
    """
    import onnxruntime as ort

    if not path.is_file():
        raise ModelError(f"The network {path} does not exist: check the path.")
    options = ort.SessionOptions()
    options.intra_op_num_threads = count_threads()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # NumPy and Numba run in between
    options.log_severity_level = 3
    providers: list[Any] = ["CPUExecutionProvider"]
    if device != "cpu":
        kind, _, number = device.partition(":")
        if kind != "cuda" or not (number or "0").isdecimal():
            raise ConfigError(f"'device' must be cpu or cuda:0, not '{device}'.")
        if "CUDAExecutionProvider" not in ort.get_available_providers():
            raise ConfigError(f"This onnxruntime does not run on {device}: pip install onnxruntime-gpu, or use cpu.")
        providers.insert(0, ("CUDAExecutionProvider", {"device_id": int(number or 0)}))
    try:
        return ort.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime's exceptions share no base class
        said = " ".join(str(error).split())[:200].rstrip(".")
        raise ModelError(f"{path} is not an ONNX network that onnxruntime can run: {said}.") from error
