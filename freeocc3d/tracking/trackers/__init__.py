"""Trackers, one file each; ../base.py is their contract."""
