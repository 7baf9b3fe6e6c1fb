"""The larger commands of ``freeocc3d``, and what all of them share: parse, call Python, print."""
