"""Options of every stage, YAML in and out, and the registry of backends."""
