#!/usr/bin/env python3
"""`freeocc3d reconstruct`; see `python tools/reconstruct.py --help`."""

import sys

from freeocc3d.cli.main import main

if __name__ == "__main__":
    main(["reconstruct", *sys.argv[1:]])
