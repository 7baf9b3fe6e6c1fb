"""LAYER 2: 3D Gaussians anchored at the points of layer 1."""
