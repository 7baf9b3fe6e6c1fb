"""Structure from motion: which frames, their features and matches, and the poses and points that these give."""
