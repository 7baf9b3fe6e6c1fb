"""Video files, decoded by a process of their own."""
