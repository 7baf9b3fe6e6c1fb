"""Scores of trajectories and maps against the truth."""
