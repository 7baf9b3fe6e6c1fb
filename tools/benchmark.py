#!/usr/bin/env python3
"""Every figure that is claimed, measured; see `python tools/benchmark.py --help`."""

from benchmark.command_line import main

if __name__ == "__main__":
    main()
