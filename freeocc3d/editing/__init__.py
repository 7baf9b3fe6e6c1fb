"""New maps from saved maps: another scale, finer voxels."""
