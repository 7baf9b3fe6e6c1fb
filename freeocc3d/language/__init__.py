"""LAYER 3: language-aligned features on the Gaussians."""
