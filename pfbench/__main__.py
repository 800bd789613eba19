"""Entry point of `python -m pfbench`."""

import os
import sys
from pathlib import Path

import pfbench

# Python puts the current folder first, where a file named like a library would run in its place
if not sys.flags.safe_path and sys.path[:1] == [os.getcwd()] != [
    str(Path(pfbench.__file__).parents[1])
]:
    del sys.path[0]

from pfbench.cli import main

main()
