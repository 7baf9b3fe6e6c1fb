"""The suffixes by which files of images are told from others. A query starts with this, so it imports no decoder."""

from __future__ import annotations

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
"""Color images that OpenCV decodes."""

HEIF_SUFFIXES = frozenset({".heic", ".heif", ".hif", ".avif"})
"""Color images that pillow-heif decodes."""

DEPTH_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".pgm", ".pfm", ".exr", ".npy", ".npz"})
"""Depth images."""
