#!/usr/bin/env python3
"""Export other files from a finished run without recomputing: python examples/export_model.py OUT FOLDER"""

import sys
from pathlib import Path

import sfm_app


def main() -> None:
    """Write the files."""
    out, folder = map(Path, sys.argv[1:])
    written = sfm_app.export_model(out, "obj", folder / "model.obj")  # with its MTL and pages of texture
    written += sfm_app.export_model(out, "ply", folder / "points.ply", points=True)  # sparse points and cameras
    for path in written:
        print(f"{path.name}: {path.stat().st_size} bytes")


if __name__ == "__main__":  # where processes are spawned, each of them imports the script
    main()
