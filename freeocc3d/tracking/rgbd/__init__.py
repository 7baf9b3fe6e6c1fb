"""What the tracker "rgbd" is made of: dense alignment, features, loop closures, the joint refinement."""
