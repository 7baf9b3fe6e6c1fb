#!/usr/bin/env python3
"""`freeocc3d ground-truth`; see `python tools/ground_truth.py --help`."""

import sys

from freeocc3d.cli.main import main

if __name__ == "__main__":
    main(["ground-truth", *sys.argv[1:]])
