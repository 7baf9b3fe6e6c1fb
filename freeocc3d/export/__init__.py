"""Exports maps to other programs' files: one module per format; base.py states their contract."""

from .base import export_map

__all__ = ["export_map"]
