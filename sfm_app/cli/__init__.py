"""The command line: parse, one call, print, exit code."""

from sfm_app.cli.main import main

__all__ = ["main"]
