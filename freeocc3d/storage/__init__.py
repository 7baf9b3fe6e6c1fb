"""The map folder and the work folder of a run in progress."""
