"""Asking a map: words, classes, pictures; regions, and conditions on where they are."""
