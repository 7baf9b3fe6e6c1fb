"""Draws pictures of maps and queries."""
