"""Scores trajectories and maps against the truth."""
