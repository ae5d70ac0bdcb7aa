"""files: Surface -> model.ply, model.glb."""

from pathlib import Path

from sfm_app.context import RunContext
from sfm_app.types import Surface

WRITTEN = ("ply", "glb")
"""Formats that every run writes."""


def model_path(run: RunContext, suffix: str) -> Path:
    """Where the finished mesh lies."""
    return run.workspace.root / f"model.{suffix}"


def write_files(surface: Surface, run: RunContext) -> tuple[Path, ...]:
    """Write the mesh in every standard format."""
    for suffix in WRITTEN:
        data = run.plugins.exporters[suffix].write(surface.vertices, surface.faces, surface.colors)
        with run.workspace.replacing(model_path(run, suffix)) as path:
            path.write_bytes(data)
    run.record(bytes={suffix: model_path(run, suffix).stat().st_size for suffix in WRITTEN})
    return load_files(run)


def load_files(run: RunContext) -> tuple[Path, ...]:
    """Paths of the files that are there."""
    return tuple(model_path(run, suffix) for suffix in WRITTEN)
