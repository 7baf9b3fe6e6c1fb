"""What every room uses: types, errors, transforms, voxel keys, files, networks, progress. Imports no other room."""
