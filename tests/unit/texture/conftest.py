"""The painted box is a module that the tests here share."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
