"""Image and text encoders, one file each; ``base`` is their contract."""
