"""Files of a capture by their names: listed, numbered, matched, unpacked."""
