"""Differentiable renderers of Gaussians behind one contract (``base``); a renderer is one file."""
