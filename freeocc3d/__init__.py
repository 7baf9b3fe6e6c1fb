"""freeocc3d: a captured indoor scan in, an occupancy map that answers words out.

import freeocc3d
scan_map = freeocc3d.reconstruct("scans/kitchen", "maps/kitchen")
for region in scan_map.query("red cup").regions:
    print(region.centroid, region.score)
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .pipeline import reconstruct
    from .store import load_map

__version__ = "0.1.0"

# Numba tries an installed TBB first and warns on stderr if it is too old; the wheels bring OpenMP anyway.
os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")

__all__ = ["__version__", "load_map", "reconstruct"]


def __getattr__(name: str) -> Any:
    """The two calls are imported when first used, so that asking for the version imports nothing."""
    if name == "reconstruct":
        from .pipeline import reconstruct

        return reconstruct
    if name == "load_map":
        from .store import load_map

        return load_map
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
