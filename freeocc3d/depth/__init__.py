"""LAYER 1: dense depth for scans without any: multi-view stereo, the scan's surface, its planes, depth networks."""
