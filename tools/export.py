#!/usr/bin/env python3
"""`freeocc3d export`; see `python tools/export.py --help`."""

import sys

from freeocc3d.cli.main import main

if __name__ == "__main__":
    main(["export", *sys.argv[1:]])
