"""`slip` that ends with a line on stderr about what it cost itself and its children."""

import json
import resource
import sys

from pipeline.cli import main

if __name__ == "__main__":
    try:
        main()
    finally:
        own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        cost = {
            "own_s": own.ru_utime + own.ru_stime,
            "children_s": children.ru_utime + children.ru_stime,
            # Linux counts the peak in KiB, macOS in bytes.
            "own_peak_bytes": own.ru_maxrss * (1 if sys.platform == "darwin" else 1024),
        }
        print(json.dumps(cost), file=sys.stderr)
