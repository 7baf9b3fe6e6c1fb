"""LAYER 2: 3D Gaussians, anchored to the points of layer 1."""
