"""Poses that captures and other systems state: trajectory files, COLMAP, nerfstudio."""
