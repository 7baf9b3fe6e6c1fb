"""Differentiable renderers of Gaussians, one file each; ``base`` is their contract."""
