"""Answers questions to a map: words, classes and pictures, with conditions on where the regions are."""
