"""LAYER 1: camera poses."""
