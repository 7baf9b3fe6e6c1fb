"""What a capture says of itself, checked: units, registration, heads of files, focal length of color."""
