"""The command line: parse, one call, print, exit code."""

from sfm_app.cli.program import main

__all__ = ["main"]
