"""LAYER 4: Gaussians to sparse voxel blocks with a probability and a language feature per voxel."""
