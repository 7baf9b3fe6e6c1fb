"""Seconds that a model takes for a frame on this machine: measured once for an installed one, else estimated."""

from __future__ import annotations

import contextlib
import json
import time

import numpy as np

from ..core.atomic_files import replace_text
from ..core.errors import FreeOccError
from ..core.regular_files import read_text
from ..core.typed_documents import as_type, parse_json
from ..core.types import Frame, Intrinsics
from ..settings import config
from . import model_packages, word_models

FRAME = 480, 640
_RUNS = 3
_KEPT = ".speeds.json"
_LARGEST = 1 << 20


def measure_frame(package: model_packages.Package) -> float | None:
    """Seconds to encode a frame of ``FRAME`` pixels with default options, the fastest of three times. They are kept in
    the models folder, so that a package is measured once. None for a model without words, or one that fails."""
    kept_in, key = model_packages.find_models_folder() / _KEPT, package.files[package.parts["image"]]
    known: dict[str, float] = {}
    with contextlib.suppress(OSError, ValueError):
        known = as_type(parse_json(read_text(kept_in, _LARGEST), finite=True), dict[str, float])
    if key not in known:
        if package.kind not in word_models.ENCODERS:
            return None
        rgb = np.random.default_rng(0).integers(0, 256, (*FRAME, 3), np.uint8)
        camera = Intrinsics(FRAME[1], FRAME[0], 500.0, 500.0, FRAME[1] / 2, FRAME[0] / 2)
        frame = Frame(0, 0.0, rgb, np.ones(FRAME, np.float32), camera)
        times = []
        try:
            encoder = word_models.use_package(config.resolve({}), package).load_backend("language", None)
            for _ in range(_RUNS):
                start = time.perf_counter()
                encoder.encode(frame)
                times.append(time.perf_counter() - start)
        except FreeOccError:
            return None
        known[key] = min(times)
        with contextlib.suppress(OSError):
            replace_text(kept_in, json.dumps(known))
    return known[key]


def measure_products() -> float:
    """float32 operations a second of a product with the weights of a ViT-B's layer. Networks in int8 reach twice as
    many on processors that multiply int8 fast, others somewhat fewer."""
    rng = np.random.default_rng(0)
    tokens, weights = rng.random((1024, 768), np.float32), rng.random((768, 3072), np.float32)
    times = []
    for _ in range(_RUNS):
        start = time.perf_counter()
        np.matmul(tokens, weights)
        times.append(time.perf_counter() - start)
    return 2 * tokens.size * weights.shape[1] / min(times)
