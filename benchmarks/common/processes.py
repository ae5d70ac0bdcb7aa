"""Start and stop the processes that are measured."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
"""Root folder of the project."""


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module of this package; it needs `environment`."""
    return [sys.executable, "-P", "-m", module, *arguments]


def environment() -> dict[str, str]:
    """Return the environment in which a process finds this project wherever it is started."""
    before = os.environ.get("PYTHONPATH")
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *([before] if before else [])])}


def row_of_module(module: str, *arguments: str) -> dict[str, Any]:
    """Return the row that a module prints as its last line, in a process of its own, so that memory is its own."""
    command = module_command(module, *arguments)
    said = subprocess.run(command, env=environment(), check=True, capture_output=True, text=True).stdout
    found: dict[str, Any] = json.loads(said.splitlines()[-1])
    return found


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
