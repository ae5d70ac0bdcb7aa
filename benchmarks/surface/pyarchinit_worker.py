"""Run pyarchinit-photogrammetry on our cameras: ``PYTHON pyarchinit_worker.py OUT TARGET JSON``.

PYTHON has that package; nothing of this project is imported. OUT is a run of ours. The JSON has arguments that are not
the defaults: `depth`, and `meshes` by name. TARGET gets NAME.npz and NAME.jpg of every mesh, and result.json.
"""

import json
import os
import shutil
import sys
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

PACKAGE = "pyarchinit-photogrammetry"


def main() -> None:
    out, target, options = Path(sys.argv[1]), Path(sys.argv[2]), json.loads(sys.argv[3])
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    chunk = load_cameras(out, target)
    add_our_quality(chunk, out)
    seconds = {"depth": cpu_s(lambda: chunk.build_depth_maps(**options["depth"])) + cpu_s(chunk.build_point_cloud)}
    for name, arguments in options["meshes"].items():
        seconds[f"mesh {name}"] = cpu_s(partial(chunk.build_model, **arguments))
        seconds[f"texture {name}"] = cpu_s(chunk.build_texture)
        save_mesh(chunk.product_path("model"), target / f"{name}.npz")
        shutil.copy(chunk.product_path("model_textured"), target / f"{name}.jpg")
    said = {"CPU s": seconds, "px": depth_width(chunk.data_dir / "dense"), "version": version(PACKAGE)}
    (target / "result.json").write_text(json.dumps(said), encoding="utf-8")


def cpu_s(make: Callable[[], Any]) -> float:
    """Return the CPU seconds of a step, in this process and its children."""
    before = sum(os.times()[:4])
    make()
    return sum(os.times()[:4]) - before


def load_cameras(out: Path, target: Path) -> Any:
    """Return a chunk of a new project with the photos, cameras and sparse points of a run of ours."""
    import pycolmap
    from pyarchinit_photogrammetry.core.document import Document
    from pyarchinit_photogrammetry.engine.sfm import import_reconstruction

    model, photos = pycolmap.Reconstruction(out / "sparse"), out / "photos"
    names = {(photos / image.name).resolve(): image.name for image in model.images.values() if image.has_pose}
    chunk = Document(target / "project.ppg").add_chunk()
    chunk.add_photos(sorted(names))
    keys = {str(camera.key): names[Path(camera.path)] for camera in chunk.cameras}
    chunk.meta["sfm"] = {"image_root": str(photos), "names": keys}
    import_reconstruction(chunk, model)
    folder = chunk.data_dir / "model"
    folder.mkdir()
    model.write(folder)
    chunk._set_product("reconstruction", folder)
    return chunk


def add_our_quality(chunk: Any, out: Path) -> None:
    """Add a quality "ours" for depth maps as wide as ours; the rival's own qualities halve the photos repeatedly."""
    from pyarchinit_photogrammetry.core.chunk import QUALITY_DOWNSCALE

    QUALITY_DOWNSCALE["ours"] = max(sensor.width for sensor in chunk.sensors.values()) / depth_width(out / "dense")


def depth_width(dense: Path) -> int:
    """Return the width of the largest depth map in a dense workspace of COLMAP."""
    maps = (dense / "stereo" / "depth_maps").rglob("*.bin")
    return max(int(path.read_bytes()[:16].split(b"&")[0]) for path in maps)


def save_mesh(path: Path, target: Path) -> None:
    """Save vertices, faces and texture coordinates, from the bottom left corner of the page."""
    from pyarchinit_photogrammetry.io.mesh_ply import read_mesh

    mesh = read_mesh(path)
    np.savez(target, vertices=mesh.xyz, faces=mesh.faces, uv=np.reshape(mesh.texcoords, (-1, 3, 2)))


if __name__ == "__main__":
    main()
