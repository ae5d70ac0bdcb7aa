"""Run `python -m benchmarks.viewers`."""

import sys

from benchmarks.viewers.command import main

if __name__ == "__main__":
    sys.exit(main())
