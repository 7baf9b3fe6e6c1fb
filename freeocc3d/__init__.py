"""freeocc3d: a captured indoor scan in, an occupancy map that answers words out.

import freeocc3d
scan_map = freeocc3d.reconstruct("scans/kitchen", "maps/kitchen")
for region in scan_map.query("red cup").regions:
    print(region.centroid, region.score)

Its rooms, in the order in which a frame passes through them; each imports from those before it alone:

    core        what every room uses: types, errors, transforms, voxel keys, arrays on disk
    settings    options of every stage, YAML in and out, the registry of backends
    capture     INPUT    captured scans, opened and decoded frame by frame
    tracking    LAYER 1  camera poses
    depth       LAYER 1  dense depth for scans without any
    gaussians   LAYER 2  3D Gaussians anchored at measured points
    language    LAYER 3  features that words can be compared with
    occupancy   LAYER 4  sparse voxels: occupied, free, unknown
    storage     the map folder and the work folder
    query       asking a map: words, classes, pictures, places
    viewer      pictures and pages of maps
    export      writers of other programs' files
    editing     new maps from saved maps
    evaluation  scores against the truth
    pipeline    the four layers together
    cli         the command line
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from .core.threads import limit_pools

if TYPE_CHECKING:
    from .pipeline.run import reconstruct
    from .query.scan_map import Map, load_map

__version__ = "0.1.0"

# Numba tries an installed TBB first and warns on stderr if it is too old; the wheels bring OpenMP anyway.
os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")
limit_pools()

__all__ = ["Map", "__version__", "load_map", "reconstruct"]


def __dir__() -> list[str]:
    """The names that completion offers; ``__getattr__`` alone would hide those that are not used yet."""
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> Any:
    """Each is imported when first used, so that asking for the version imports nothing."""
    if name not in ("Map", "load_map", "reconstruct"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .query import scan_map

    scan_map.Map._repr_html_ = _show_in_cell  # type: ignore[attr-defined]
    if name == "reconstruct":
        from .pipeline.run import reconstruct

        return reconstruct
    return getattr(scan_map, name)


def _show_in_cell(scan_map: Map) -> str:
    """What a notebook shows of a map. The room of maps stands before that of viewers, so it is given here."""
    from .viewer.browser.notebooks import show_in_cell

    return show_in_cell(scan_map)
