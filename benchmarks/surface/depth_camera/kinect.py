"""Compare a surface with what a depth camera saw that was fixed beside the camera of the photos."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.cameras.score import true_photos
from benchmarks.common.metrics import Pose
from benchmarks.common.results import Row
from benchmarks.corpus.trajectory import offset_errors
from benchmarks.surface.depth_camera.scan import Scan, align
from benchmarks.surface.rendered.truth import sights_of
from sfm_app.geometry.poses import Similarity
from sfm_app.meshing.ray_casting import load_open3d
from sfm_app.synthetic.cameras import Camera
from sfm_app.synthetic.compare import sample_surface, surface_distances
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.types import Surface
from sfm_app.types.scene import camera_center

FloatArray = NDArray[np.float64]
ACCURATE_M, COMPLETE_M, FAR_M = 0.03, 0.05, 0.1
"""Distance limits in meters: of accuracy, of completeness, and beyond which nothing of the scan is near."""
DEPTHS_M = (0.4, 3.5)
"""Depths that a Kinect measures and that the scan was made from, in meters."""
SAMPLES = 100_000
"""Number of points that a surface is sampled at, evenly over its area; they determine shares to 0.2 %."""
FOCAL_PX, WIDTH, HEIGHT = 585.0, 640, 480
"""The depth camera of a Kinect. Longer than the 525 of its color camera, which cameras.json states: nearly all points
of the scan of kitchen1000 lie in three frames of a camera of 585 pixels, as many as a point takes, but of no longer."""
HIDDEN_M = 0.02
"""How far behind the first surface on a ray a place still counts as seen, in meters."""


@dataclass(frozen=True, slots=True, eq=False)
class KinectTruth:
    """What a depth camera saw, and from where."""

    scan: Scan
    camera: Camera
    """The depth camera."""
    poses: Mapping[str, Pose]
    """(3, 4) cam_from_world of the depth camera, by photo name without suffix."""


class CameraDifferences(NamedTuple):
    """How the depth camera's poses differ from ours."""

    offset: FloatArray
    """(3,) median place of our camera in the frame of the depth camera, in meters."""
    turn_deg: FloatArray
    """(N,) by photo: rotation against the depth camera, without the mean."""
    pivot_m: float
    """Depth of the point ahead that cameras are turned about which are turned wrongly."""
    explained: float
    """Share of the squared sideways differences of the places that turning about that point explains, up to 1."""


def load_kinect(folder: Path) -> KinectTruth:
    """Read surface.ply and cameras.json.

    Args:
        folder: folder of a set that has both.
    """
    cloud = load_open3d().io.read_point_cloud(str(folder / "surface.ply"))
    photos = true_photos(folder / "cameras.json", ())
    K = np.array([[FOCAL_PX, 0.0, WIDTH / 2], [0.0, FOCAL_PX, HEIGHT / 2], [0.0, 0.0, 1.0]])
    poses = {name: photo.pose for name, photo in photos.items()}
    return KinectTruth(Scan.from_points(np.asarray(cloud.points)), Camera(K, WIDTH, HEIGHT), poses)


def kinect_scores(surface: Surface, poses: Mapping[str, Pose], truth: KinectTruth, count: int = SAMPLES) -> Row:
    """Return how much of a surface is right, and how much is there, after alignment by the cameras, and after ICP.

    Args:
        surface: in the frame of the reconstruction.
        poses: (3, 4) cam_from_world in that frame, by photo name without suffix.
        truth: what the depth camera saw.
        count: number of points that the surface is sampled at.
    """
    offset = offset_errors(poses, truth.poses)
    if offset is None or not len(surface.faces):
        return {}
    row: Row = {
        "median center cm": _cm(np.median(offset.center)),
        "90 % center cm": _cm(np.percentile(offset.center, 90)),
        "cameras apart cm": _cm(offset.shift),
        "cameras turned deg": round(float(np.median(offset.rotation_deg)), 2),
        "scan: rough cm": _cm(np.nanmedian(truth.scan.roughness)),
    }
    samples, _ = sample_surface(surface.vertices, surface.faces, count)
    row |= _figures(surface, samples, offset.world, truth, sorted(poses))
    moved = offset.world(samples)
    try:
        onto = align(moved, truth.scan)
    except ValueError:
        return row
    figures = _figures(surface, samples, onto.compose(offset.world), truth, sorted(poses))
    row["ICP: moved by cm"] = _cm(np.median(np.linalg.norm(onto(moved) - moved, axis=1)))
    row["ICP: scaled by %"] = round(100.0 * (onto.scale - 1.0), 2)
    differences = compare_cameras(poses, truth.poses, onto.compose(offset.world))
    row |= {
        "ICP: cameras apart cm": _cm(np.linalg.norm(differences.offset)),
        "ICP: cameras turned deg": round(float(np.median(differences.turn_deg)), 2),
        "ICP: turned about m": round(differences.pivot_m, 2),
        "ICP: which explains %": round(100.0 * differences.explained, 1),
    }
    return row | {f"ICP: {name}": value for name, value in figures.items()}


def compare_cameras(found: Mapping[str, Pose], truth: Mapping[str, Pose], world: Similarity) -> CameraDifferences:
    """Compare our cameras with the depth camera under a given alignment.

    Args:
        found: (3, 4) cam_from_world in the frame of the reconstruction, by photo name without suffix.
        truth: of the depth camera.
        world: from the frame of the reconstruction to that of the truth.
    """
    names = sorted(set(found) & set(truth))
    centers = world(np.array([camera_center(found[name]) for name in names]))
    places = np.array([truth[n][:, :3] @ center + truth[n][:, 3] for n, center in zip(names, centers, strict=True)])
    turns = Rotation.from_matrix(np.array([truth[n][:, :3] @ world.R @ found[n][:, :3].T for n in names]))
    turn = (turns.mean().inv() * turns).as_rotvec()
    offset = np.median(places, axis=0)
    # a camera that turns by a small angle about a point ahead at depth d moves sideways by d times that
    sideways, ways = np.cross(turn, [0.0, 0.0, 1.0])[:, :2], (places - offset)[:, :2]
    depth = float((sideways * ways).sum() / max((sideways**2).sum(), 1e-12))
    rest = float(((ways - depth * sideways) ** 2).sum() / max((ways**2).sum(), 1e-12))
    return CameraDifferences(offset, np.degrees(np.linalg.norm(turn, axis=1)), -depth, 1.0 - rest)


def within_reach(places: FloatArray, surface: Surface, truth: KinectTruth, names: list[str]) -> NDArray[np.bool_]:
    """Return whether a depth camera could have seen places of a surface: in its picture, in its range, not hidden.

    Args:
        places: (M, 3) of the surface.
        surface: that may hide them, in the frame of the truth.
        truth: has the cameras.
        names: of the photos that were used, without suffix.
    """
    poses = {name: truth.poses[name] for name in names if name in truth.poses}
    views = Truth(dict.fromkeys(poses, truth.camera), poses, surface.vertices, surface.faces)
    slack = np.full(len(places), HIDDEN_M)
    return sights_of(views, places, None, slack, DEPTHS_M).count > 0


def _figures(surface: Surface, samples: FloatArray, world: Similarity, truth: KinectTruth, names: list[str]) -> Row:
    """Return the figures under one alignment."""
    moved = Surface(world(surface.vertices), surface.faces, surface.colors)
    places = world(samples)
    away, to_point = truth.scan.distances(places), truth.scan.point_distances(places)
    reached = within_reach(places, moved, truth, names)
    missing = surface_distances(truth.scan.points, moved.vertices, moved.faces)
    row: Row = {
        "accuracy 3 cm %": _percent(away <= ACCURATE_M),
        "3 cm of a point %": _percent(to_point <= ACCURATE_M),
        "completeness 5 cm %": _percent(missing <= COMPLETE_M),
        "median cm": _cm(np.median(away)),
        "over 10 cm off %": _percent(to_point > FAR_M),
        "in reach %": _percent(reached),
    }
    if not reached.any():
        return row
    return row | {
        "in reach: accuracy 3 cm %": _percent(away[reached] <= ACCURATE_M),
        "in reach: median cm": _cm(np.median(away[reached])),
    }


def _cm(value: float | np.floating) -> float:
    return round(100.0 * float(value), 2)


def _percent(those: NDArray[np.bool_]) -> float:
    return round(100.0 * float(np.mean(those)), 2)
