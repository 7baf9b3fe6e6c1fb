"""Seeded attacks on everything that comes in: one module for each part, a harness, and the command that runs them."""
