"""What every room uses: types, errors, transforms, voxel keys, arrays on disk, networks, progress. Imports no room."""
