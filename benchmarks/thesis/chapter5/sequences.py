"""The available image sequences of thesis section 5.9: matches, size and true camera matrices."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from benchmarks.common.metrics import load_truth
from benchmarks.thesis.corners import load_corners
from sfm_app.api import open_run
from sfm_app.pipeline import MATCH_GRAPH, VIEW_GRAPH, run_stages
from sfm_app.settings import Settings
from sfm_app.types.photos import PairId

FloatArray = NDArray[np.float64]
LEAST_CORNERS = 20
"""Least number of shared corners of a pair of views."""
CORNERS = {
    "Corridor": ("Corridor", (512, 512)),
    "Wadham": ("Wadham-College", (1024, 768)),
    "Merton1": ("Merton-College-I", (1024, 768)),
    "Merton2": ("Merton-College-II", (1024, 768)),
    "Merton3": ("Merton-College-III", (1024, 768)),
}
"""Folder under vgg-corners, and the photos' width and height in pixels."""
PHOTOS = {"Castle-P19": "castle-P19", "Fountain-P11": "fountain-P11"}


@dataclass(frozen=True, slots=True, eq=False)
class ImageSequence:
    """Photos of one scene."""

    name: str
    size: tuple[int, int]
    Ks: FloatArray
    """(V, 3, 3) true camera matrix per view."""
    matches: Mapping[PairId, FloatArray]
    """Per pair of views (N, 4) x1, y1, x2, y2 in pixels, unfiltered."""
    Fs: Mapping[PairId, FloatArray]
    """True (3, 3) fundamental matrices, unit norm; empty where the cameras of the photos are not needed."""

    @property
    def K(self) -> FloatArray:
        """(3, 3) camera matrix of the first view, which Table 5.2 takes as the truth."""
        first: FloatArray = self.Ks[0]
        return first

    def first(self, count: int) -> "ImageSequence":
        """Return the sequence of the first views alone."""
        ids = sorted({view for pair in self.matches for view in pair})[:count]
        kept = {pair: rows for pair, rows in self.matches.items() if set(pair) <= set(ids)}
        return replace(self, matches=kept)


def corner_sequence(data: Path, name: str) -> ImageSequence:
    """Read corners and cameras of a VGG sequence under DATA/vgg-corners; all of its pairs are used."""
    folder, size = data / "vgg-corners" / CORNERS[name][0], CORNERS[name][1]
    Ps = np.array([np.loadtxt(path) for path in sorted(folder.glob("*.P"))])
    found = {
        pair: np.hstack(load_corners(folder, pair[0] + 1, pair[1] + 1)) for pair in combinations(range(len(Ps)), 2)
    }
    matches = {pair: rows for pair, rows in found.items() if len(rows) >= LEAST_CORNERS}
    Fs = {(i, j): fundamental_from_projections(Ps[i], Ps[j]) for i, j in matches}
    return ImageSequence(name, size, np.array([camera_matrix_from_projection(P) for P in Ps]), matches, Fs)


def photo_sequence(data: Path, name: str, cache: Path) -> ImageSequence:
    """Read the raw matches of the pairs that the program keeps, from CACHE/NAME, or make them from DATA/NAME/images."""
    place = data / PHOTOS[name]
    with open_run(cache / PHOTOS[name], Settings(), None) as run:
        products = run_stages([place / "images"], run, last=VIEW_GRAPH.name)
        graph = products[MATCH_GRAPH]
        views = products[VIEW_GRAPH]
    matches = {pair: np.hstack(graph.points(pair)) for pair, fit in views.fits.items() if not fit.degeneracy}
    truth = load_truth(place / "cameras.json")
    first = next(iter(graph.images.values()))
    return ImageSequence(name, (first.width, first.height), np.array([K for K, _ in truth.values()]), matches, {})


def camera_matrix_from_projection(P: FloatArray) -> FloatArray:
    """Decompose a projection matrix P ~ K [R | t] (3, 4), and return K (3, 3), positive diagonal, K[2, 2] = 1."""
    K, _ = rq(P[:, :3])
    K = K * np.sign(np.diag(K))
    return np.asarray(K / K[2, 2])


def fundamental_from_projections(P1: FloatArray, P2: FloatArray) -> FloatArray:
    """Compute F (3, 3) of unit norm with x2' F x1 = 0 (Hartley & Zisserman, eq. 9.1)."""
    center = np.linalg.svd(P1)[2][-1]
    e2 = P2 @ center
    cross = np.array([[0, -e2[2], e2[1]], [e2[2], 0, -e2[0]], [-e2[1], e2[0], 0]])
    F = cross @ P2 @ np.linalg.pinv(P1)
    return np.asarray(F / np.linalg.norm(F))
