"""Run Python as if by a user who is not root: ordinary.py ARGUMENTS. Root ignores file modes."""

import ctypes
import os
import sys

DROP_FROM_BOUNDING_SET = 24
READS_AND_WRITES_ALL, READS_ALL = 1, 2
"""Linux's numbers of the capabilities that bypass file modes (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH)."""

if __name__ == "__main__":
    if sys.platform == "linux" and os.geteuid() == 0:
        for capability in (READS_AND_WRITES_ALL, READS_ALL):
            ctypes.CDLL(None).prctl(DROP_FROM_BOUNDING_SET, capability, 0, 0, 0)  # holds from the next exec on
    os.execv(sys.executable, [sys.executable, *sys.argv[1:]])  # noqa: S606 - Python
