"""LAYER 1: dense depth for scans without depth: multi-view stereo, surface, building planes, depth networks."""
