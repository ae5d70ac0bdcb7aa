"""Fundamental matrices, cameras and relative poses of all folders with one constant changed: one JSON line.

    python -m benchmarks.sensitivity.worker CACHE [PATH NAMES FACTOR]

It imports the program only after the constant is changed.
"""

import json
import os
import pickle
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.sensitivity.constants import Constant, install, is_compiled


def measure(folder: Path, seed: int) -> dict[str, float]:
    """Return the figures of one folder.

    Args:
        folder: holds what `command.prepare` has left.
        seed: of the run.
    """
    # here, because it imports the program
    from benchmarks.sensitivity.problem import Problem, figures

    problem: Problem = pickle.loads((folder / "problem.pickle").read_bytes())  # noqa: S301 -- our own
    return figures(problem, seed)


def main() -> None:
    """Read the arguments, and print the figures of every folder."""
    cache, *changed = sys.argv[1:]
    seed = int(os.environ.get("SENSITIVITY_SEED", "0"))
    scratch = None
    if changed:
        constant = Constant(changed[0], changed[1])
        if is_compiled(constant):
            scratch = tempfile.TemporaryDirectory()
            os.environ["NUMBA_CACHE_DIR"] = scratch.name
        install(constant, float(changed[2]))
    found: dict[str, Any] = {}
    for folder in sorted(path.parent for path in Path(cache).glob("*/problem.pickle")):
        try:
            found[folder.name] = measure(folder, seed)
        except Exception as err:  # a constant that breaks the program is a result
            found[folder.name] = {"failed": f"{type(err).__name__}: {err}"}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
