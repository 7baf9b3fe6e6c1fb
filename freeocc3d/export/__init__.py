"""Writers of finished maps, one file per format; base.py is their contract."""

from .base import export_map

__all__ = ["export_map"]
