"""Which way is up, and the frame with z up, the floor at z = 0 and the walls along x and y."""
