"""The names of the files in a map folder.

map.yaml  config.yaml  report.json  trajectory.txt  trajectory.png  gaussians.ply  gaussians.png  occupancy.npz
features.npz  objects.npz  keyframes/
"""

MANIFEST, CONFIG, REPORT = "map.yaml", "config.yaml", "report.json"
TRAJECTORY, GAUSSIANS, OCCUPANCY, FEATURES = "trajectory.txt", "gaussians.ply", "occupancy.npz", "features.npz"
PATH_PICTURE, RENDER_PICTURE = "trajectory.png", "gaussians.png"
OBJECTS, KEYFRAMES = "objects.npz", "keyframes"

ALWAYS = (CONFIG, REPORT, TRAJECTORY, GAUSSIANS, OCCUPANCY, FEATURES)
"""Files of every map, besides the manifest and the keyframes."""

PICTURES = (PATH_PICTURE, RENDER_PICTURE)
"""Files that a map may lack."""
