"""The built-in room."""
