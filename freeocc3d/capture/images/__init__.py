"""Decodes stored images: color, depth of every kind, HEIC, LZFSE."""
