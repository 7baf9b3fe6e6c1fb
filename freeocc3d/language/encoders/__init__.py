"""Image and text encoders, one file each; base.py is their contract."""
