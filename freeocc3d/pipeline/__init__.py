"""The only room that knows all four layers: capture -> track -> gaussians -> language -> occupancy -> storage."""
