"""Readers of captures, one file for each format; ../base.py is their contract."""
