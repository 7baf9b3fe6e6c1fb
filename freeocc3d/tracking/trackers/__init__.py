"""Trackers, one file each; ``../base.py`` defines their contract."""
