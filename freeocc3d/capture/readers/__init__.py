"""Readers of captures, one file per format; ``../base.py`` defines their contract."""
