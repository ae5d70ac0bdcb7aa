"""The benchmarks are scripts: their helpers are found beside them, as when a script runs."""

import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
sys.path += [str(BENCHMARKS / "accuracy"), str(BENCHMARKS / "thesis")]
