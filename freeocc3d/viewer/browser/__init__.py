"""The viewer in a browser: a server of maps on this machine, and pages that hold a whole map."""
