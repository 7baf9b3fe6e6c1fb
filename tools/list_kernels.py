#!/usr/bin/env python3
"""Runs a command of freeocc3d, and lists the compiled functions that it called, with the types of their arguments:

    python tools/list_kernels.py freeocc3d/core/first_kernels.txt demo -o /tmp/demo --overwrite

Only what it found compiled is listed: run it twice after a change of kernels.
"""

from __future__ import annotations

import sys
from pathlib import Path

from freeocc3d.cli.main import main
from freeocc3d.core.ahead_of_time import list_used

if __name__ == "__main__":
    try:
        main(sys.argv[2:])
    finally:
        Path(sys.argv[1]).write_text("".join(f"{line}\n" for line in list_used()), encoding="utf-8")
