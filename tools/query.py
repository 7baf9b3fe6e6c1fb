#!/usr/bin/env python3
"""`freeocc3d query`; see `python tools/query.py --help`."""

import sys

from freeocc3d.cli.main import main

if __name__ == "__main__":
    main(["query", *sys.argv[1:]])
