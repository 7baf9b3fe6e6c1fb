"""The command ``freeocc3d``: parses, calls Python, prints. Nothing else prints."""
