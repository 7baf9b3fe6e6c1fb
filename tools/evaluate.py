#!/usr/bin/env python3
"""`freeocc3d evaluate`; see `python tools/evaluate.py --help`."""

import sys

from freeocc3d.cli.main import main

if __name__ == "__main__":
    main(["evaluate", *sys.argv[1:]])
