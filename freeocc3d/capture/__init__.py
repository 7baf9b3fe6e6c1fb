"""INPUT: captured scans. ``open_capture`` finds the reader of a folder; ``read_ahead`` decodes on a second thread."""
