"""Start and stop the processes that are measured."""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
"""Root folder of the project."""


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module of this package; it needs `environment`."""
    return [sys.executable, "-P", "-m", module, *arguments]


def environment() -> dict[str, str]:
    """Return the environment in which a process finds this project wherever it is started."""
    before = os.environ.get("PYTHONPATH")
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *([before] if before else [])])}


def run_command(command: Sequence[str], limit_s: float | None = None) -> tuple[int | None, str]:
    """Return a command's exit code (None if stopped after `limit_s`), and its error or last line on stderr."""
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors:
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True, env=environment()
        )
        try:
            code: int | None = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            if process.poll() is None:  # too slow, or we are interrupted
                os.killpg(process.pid, signal.SIGKILL)  # mappers run in processes of their own
                process.wait()
        errors.seek(0)
        lines = errors.read().strip().splitlines() or ["no output on stderr"]
        return code, next((line for line in reversed(lines) if line.startswith("error: ")), lines[-1])
