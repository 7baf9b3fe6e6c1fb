"""All four layers together: frames in, a map out."""
