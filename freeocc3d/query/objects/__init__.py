"""Finds the things of a room: objects with a feature, names, a box and the keyframes that show them."""
