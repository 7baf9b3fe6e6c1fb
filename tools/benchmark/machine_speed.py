"""The highest speeds of this machine: copies of memory, and exponentials."""

from __future__ import annotations

from freeocc3d.core.threads import count_threads

from .timing import time_fastest


def copy_bytes_per_second() -> float:
    """Bytes read and written a second by a NumPy copy of 256 MB on one thread."""
    import numpy as np

    source = np.ones(256_000_000, np.uint8)
    target = np.zeros_like(source)
    return 2 * source.nbytes / time_fastest(lambda: np.copyto(target, source))


def exps_per_second() -> float:
    """float32 exponentials a second, NumPy's vectorized one on one thread times the number of processors."""
    import numpy as np

    values = -np.random.default_rng(0).random(1 << 20, np.float32)
    out = np.empty_like(values)
    return len(values) * count_threads() / time_fastest(lambda: np.exp(values, out=out))
