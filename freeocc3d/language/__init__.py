"""LAYER 3: language-aligned features of the Gaussians."""
