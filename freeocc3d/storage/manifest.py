"""What a map's manifest has to say, checked before anything else is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core.errors import MapError

MANIFEST = "map.yaml"


def check_manifest(manifest: dict[str, Any], path: Path) -> None:
    """Raises MapError for a manifest of the map at ``path`` that lacks what every map says, or names a file outside."""
    needed = {
        "voxel_size_m": float, "origin": list, "up": list, "encoder": dict, "keyframes": list, "files": dict,
        "counts": dict, "capture": dict, "T_world_map": list, "freeocc3d": str,
    }  # fmt: skip
    for key, kind in needed.items():
        if not isinstance(manifest.get(key), kind):
            raise MapError(f"{path / MANIFEST} is damaged: '{key}' is missing or not a {kind.__name__}.")
    inner: dict[str, tuple[str, ...]] = {
        "encoder": ("name", "state"),
        "capture": ("path", "format"),
        "counts": ("gaussians", "voxels", "frames", "frames_with_pose", "submaps"),
    }
    for key, names in inner.items():
        if missing := [name for name in names if name not in manifest[key]]:
            raise MapError(f"{path / MANIFEST} is damaged: '{key}' lacks {', '.join(missing)}.")
    if (named := manifest.get("vocabulary")) is not None and not _is_vocabulary(named):
        raise MapError(f"{path / MANIFEST} is damaged: 'vocabulary' does not hold names with their counts.")
    scale = manifest.get("scale", {"metric": True})
    if not isinstance(scale, dict) or not isinstance(scale.get("metric"), bool):
        raise MapError(f"{path / MANIFEST} is damaged: 'scale' does not say whether lengths are metres.")
    for name in manifest["files"]:
        inside = (path / str(name)).resolve().is_relative_to(path.resolve())
        if not inside:
            raise MapError(f"{path / MANIFEST} is damaged: '{name}' lies outside the map's folder.")


def _is_vocabulary(named: Any) -> bool:
    """Whether an entry of a manifest is what ``language.scene_vocabulary`` makes."""
    if not isinstance(named, dict) or not isinstance(named.get("keyframes"), list):
        return False
    names = named.get("names")
    return isinstance(names, dict) and all(
        isinstance(name, str) and isinstance(entry, dict) and isinstance(entry.get("count"), int)
        for name, entry in names.items()
    )
