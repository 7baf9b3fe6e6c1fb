"""LAYER 4: turns Gaussians into sparse voxel blocks with a probability and a language feature per voxel."""
