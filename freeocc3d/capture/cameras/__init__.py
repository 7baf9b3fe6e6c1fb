"""Cameras of captures: calibration files, lenses, undistortion, rigs of color and depth."""
