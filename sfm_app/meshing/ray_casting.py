"""Nearest points of a mesh, by Open3D."""

import functools
import importlib
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import SfmError
from sfm_app.geometry.triangles import median_edge_length, vertex_normals
from sfm_app.operating_system import load_libusb

PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libidn2.so.0": "libidn2-0",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
"""Packages of Debian and Ubuntu with the libraries to which Open3D's wheels for Linux link."""


@functools.cache
def load_open3d() -> Any:
    """Import Open3D, which takes more than a second; an SfmError names a library that the system lacks."""
    load_libusb()
    try:
        open3d = importlib.import_module("open3d")
    except (ImportError, OSError) as err:
        missing = re.search(r"(lib\S+\.so[.\d]*): cannot open", str(err))
        packages = [PACKAGES[missing[1]]] if missing and missing[1] in PACKAGES else sorted(PACKAGES.values())
        hint = f"on Debian and Ubuntu: apt-get install {' '.join(packages)}"
        raise SfmError(f"Open3D cannot be loaded: {err}", hint=hint) from err
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


REACH_EDGES = 4.0
"""Largest distance of a point from the fine surface, in median edges of it. Chosen on fountain-P11 with 50 000
triangles (benchmarks/surface/normal_map.py): 1 leaves out 0.4 % of the texels, 16 none that 4 leaves out, at equal
angles."""


class NearestNormals:
    """Normals of a fine surface at the places closest to points; safe for threads."""

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> None:
        """Prepare the search; vertices (V, 3), faces (T, 3) vertex indices."""
        self._faces, self._scene = faces, None
        if not len(faces):
            return
        places = vertices.astype(np.float64)
        self._normals = vertex_normals(places, faces.astype(np.int64)).astype(np.float32)
        self._reach = REACH_EDGES * median_edge_length(places, faces.astype(np.int64))
        self._tensor = load_open3d().core.Tensor
        self._scene = load_open3d().t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(self._tensor(vertices), self._tensor(faces.astype(np.uint32)))
        self.find(vertices[:1], self._normals[:1])  # builds the tree, which only one thread may

    def find(self, points: NDArray[np.float32], facing: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return (N, 3) unit normals at the closest place; 0 where it is far or faces away from `facing` (N, 3)."""
        if self._scene is None or not len(points):
            return np.zeros_like(points)
        closest = self._scene.compute_closest_points(self._tensor(np.ascontiguousarray(points)), nthreads=1)
        second = closest["primitive_uvs"].numpy()
        shares = np.concatenate([1.0 - second.sum(axis=1, keepdims=True), second], axis=1)
        corners = self._normals[self._faces[closest["primitive_ids"].numpy().astype(np.int64)]]
        normals = (shares[:, :, None] * corners).sum(axis=1)
        length = np.linalg.norm(normals, axis=1)
        good = np.linalg.norm(closest["points"].numpy() - points, axis=1) <= self._reach
        good &= ((normals * facing).sum(axis=1) > 0) & (length > 0)
        return np.where(good[:, None], normals / np.where(good, length, 1.0)[:, None], 0).astype(np.float32)
