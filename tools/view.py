#!/usr/bin/env python3
"""`freeocc3d view`; see `python tools/view.py --help`."""

import sys

from freeocc3d.cli.main import main

if __name__ == "__main__":
    main(["view", *sys.argv[1:]])
