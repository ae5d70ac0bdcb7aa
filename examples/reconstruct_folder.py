#!/usr/bin/env python3
"""A whole run from Python: python examples/reconstruct_folder.py PHOTOS OUT"""

import sys

import sfm_app


def main() -> None:
    """Reconstruct the photos, and print what was found."""
    settings = sfm_app.Settings.from_mapping({"quality": "draft"})
    run = sfm_app.reconstruct(sys.argv[1], sys.argv[2], settings)
    print(f"{len(run.scene.registered)} photos placed, K before bundle adjustment:\n{run.calibration.K.round(1)}")
    print(f"mesh: {run.mesh_path}")


if __name__ == "__main__":  # where processes are spawned, each of them imports the script
    main()
