"""`python -m pipeline` is `slip`."""

import sys
from pathlib import Path

# Python has put the current folder first; what lies there is no part of slip, unless slip itself does.
if not sys.flags.safe_path and Path(sys.path[0]).resolve() != Path(__file__).resolve().parents[1]:
    del sys.path[0]

from pipeline.cli import main

if __name__ == "__main__":
    main()
