"""Real pairs of photos with matches and true geometry: read from .npz files, or made from photo sets.

A file holds "PAIR/x1", "PAIR/x2" (N, 2) pixels, "PAIR/F", "PAIR/K1", "PAIR/K2", "PAIR/R" (3, 3) and "PAIR/t" (3,) of
cam2_from_cam1.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.metrics import load_truth
from sfm_app.api import open_run
from sfm_app.geometry.epipolar import fundamental_from_pose, sampson_distance
from sfm_app.pipeline import MATCH_GRAPH, run_stages
from sfm_app.settings import Settings

FloatArray = NDArray[np.float64]

TRUE_PX = 2.0
"""A match within this distance of the true epipolar geometry counts as a true inlier."""
LEAST_SHARE, LEAST_TRUE = 0.1, 16
"""Pairs with a smaller share, or number, of true inliers are left out: they hardly overlap."""

_FIELDS = ("x1", "x2", "F", "K1", "K2", "R", "t")


@dataclass(frozen=True, slots=True, eq=False)
class RealPair:
    """Matches of two photos, with the true geometry."""

    photos: str
    """Name of the photo set."""
    name: str
    x1: FloatArray
    x2: FloatArray
    F: FloatArray
    K1: FloatArray
    K2: FloatArray
    R: FloatArray
    t: FloatArray

    @property
    def is_true(self) -> NDArray[np.bool_]:
        """(N,) whether a match is near the true geometry."""
        return np.asarray(sampson_distance(self.F, self.x1, self.x2) < TRUE_PX)

    @property
    def is_usable(self) -> bool:
        """Whether the two photos overlap enough."""
        true = self.is_true
        return int(np.count_nonzero(true)) >= LEAST_TRUE and float(true.mean()) >= LEAST_SHARE


def load_pairs(files: list[Path], limit: int | None = None) -> list[RealPair]:
    """Read the usable pairs of all files, at most `limit` evenly spaced ones of each."""
    found: list[RealPair] = []
    for path in files:
        with np.load(path) as data:
            names = sorted({key.rsplit("/", 1)[0] for key in data.files})
            read = (
                RealPair(path.stem, name, *(data[f"{name}/{field}"].astype(np.float64) for field in _FIELDS))
                for name in names
            )
            usable = [pair for pair in read if pair.is_usable]
        found += usable if limit is None else subsample(usable, limit)
    return found


def subsample(pairs: list[RealPair], limit: int) -> list[RealPair]:
    """Take at most `limit` of the pairs, spread evenly over the list."""
    if len(pairs) <= limit:
        return pairs
    return [pairs[i] for i in np.linspace(0, len(pairs) - 1, limit).round().astype(int)]


def cached_ratio_matches(data: Path, name: str, cache: Path) -> Path:
    """Match a photo set with the program's own matching, COLMAP's ratio test included; the file is kept in `cache`.

    Args:
        data: folder with NAME/images and NAME/cameras.json.
        name: the photo set.
        cache: folder of NAME.npz, which is written if missing.
    """
    path = cache / f"{name}.npz"
    if not path.exists():
        print(f"matching {name}", file=sys.stderr)
        cache.mkdir(parents=True, exist_ok=True)
        with open_run(cache / name, Settings(), None) as run:
            graph = run_stages([data / name / "images"], run, last=MATCH_GRAPH.name)[MATCH_GRAPH]
        truth = load_truth(data / name / "cameras.json")
        arrays: dict[str, Any] = {}
        for ids in graph.matches:
            first, second = (Path(graph.images[key].name).stem for key in ids)
            if first in truth and second in truth and len(graph.matches[ids]):
                fields = true_fields(truth[first], truth[second]) | dict(
                    zip(("x1", "x2"), graph.points(ids), strict=True)
                )
                arrays |= {f"{first}-{second}/{field}": value for field, value in fields.items()}
        np.savez_compressed(path, allow_pickle=False, **arrays)
    return path


def true_fields(first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray]) -> dict[str, FloatArray]:
    """Return the fields of a pair besides its matches, from K and (3, 4) cam_from_world of both photos."""
    (K1, pose1), (K2, pose2) = first, second
    R = pose2[:, :3] @ pose1[:, :3].T
    t = pose2[:, 3] - R @ pose1[:, 3]
    return {"F": fundamental_from_pose(K1, K2, R, t), "K1": K1, "K2": K2, "R": R, "t": t}
