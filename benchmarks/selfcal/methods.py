"""Calibrations of one photo set before bundle adjustment: by the program's stage, by a calibrator alone, by COLMAP."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import sfm_app
from benchmarks.common.photo_sets import PhotoSet, TrueCamera
from benchmarks.selfcal import rivals
from sfm_app.api import open_run
from sfm_app.camera.models import camera_matrix
from sfm_app.estimation.calibrating import photo_pairs
from sfm_app.pipeline import INTRINSICS, MATCH_GRAPH, VIEW_GRAPH, run_stages
from sfm_app.plugins import load_plugins
from sfm_app.settings import Settings, merge_nested
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.types import Calibration, CameraPairs, Intrinsics, MatchedImage, MatchGraph, ViewGraph
from sfm_app.types.scene import CameraModel

PRODUCTION = "zero-curves"
WITHOUT_MATCHES = f"{PRODUCTION} without matches"
"""The consensus on the fundamental matrices alone, which has no lens model."""
ANSWER = ("fx_px", "fy_px", "cx_px", "cy_px")
"""Evidence in which a method of the thesis leaves its own answer, whatever our verdict on it."""


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult:
    """The result of one method on one photo set."""

    method: str
    cameras: Mapping[str, Calibration]
    """By photo name without suffix."""
    seconds: float
    pairs: int
    """Number of fundamental matrices that it could use."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchedSet:
    """A photo set up to its fundamental matrices, which all methods share."""

    photos: PhotoSet
    out: Path
    """Output folder of the program."""
    settings: Settings
    matches: MatchGraph
    views: ViewGraph
    matching_seconds: float
    """Seconds of features and matching in the run that made them."""

    @property
    def groups(self) -> list[list[MatchedImage]]:
        """Photos grouped by the camera that they are assumed to share."""
        images = list(self.matches.images.values())
        return [[image for image in images if image.group == name] for name in dict.fromkeys(i.group for i in images)]


def match_set(photos: PhotoSet, cache: Path, seed: int = 0) -> MatchedSet:
    """Run the program up to the fundamental matrices, or take them from the cache."""
    settings = Settings.from_mapping({"seed": seed, "workers": 1, "photos": {"cameras": photos.cameras}})
    out = cache / "out" / photos.folder.name
    with open_run(out, settings, None) as run:
        products = run_stages([photos.folder], run, last=VIEW_GRAPH.name)
        matches, views = products[MATCH_GRAPH], products[VIEW_GRAPH]
        seconds = run.workspace.manifest.read()["stages"]["match_graph"]["seconds"]
    return MatchedSet(photos, out, settings, matches, views, seconds)


def run_production(
    subject: MatchedSet, overrides: Mapping[str, object] | None = None, label: str = PRODUCTION
) -> MethodResult:
    """Run the stage `intrinsics` in full, with other settings where given."""
    settings = Settings.from_mapping(merge_nested(subject.settings.model_dump(), overrides or {}))
    with open_run(subject.out, settings, None) as run:
        found = run_stages([subject.photos.folder], run, first=INTRINSICS.name, last=INTRINSICS.name)[INTRINSICS]
        seconds = run.workspace.manifest.read()["stages"]["intrinsics"]["seconds"]
    cameras = {Path(image.name).stem: image_camera(image, found) for image in subject.matches.images.values()}
    return MethodResult(label, cameras, seconds, len(subject.views.fits))


def image_camera(image: MatchedImage, found: Intrinsics) -> Calibration:
    """Return the camera that the program assigns to a photo."""
    return found.camera(image)


def run_calibrator(subject: MatchedSet, method: str) -> MethodResult:
    """Run a calibrator alone on the pairs within each camera; its own answer counts even if our verdict rejects it."""
    calibrator = load_plugins().calibrator(PRODUCTION if method == WITHOUT_MATCHES else method)
    cameras: dict[str, Calibration] = {}
    seconds, pairs = 0.0, 0
    for images in subject.groups:
        ids = [image.id for image in images]
        of_camera = photo_pairs(images, subject.matches, subject.views).to_camera_pairs(ids)
        if method == WITHOUT_MATCHES:
            of_camera = replace(of_camera, inliers=())
        start = time.perf_counter()
        found = calibrator.calibrate(of_camera, subject.settings.calibration, subject.settings.seed)
        seconds += time.perf_counter() - start
        pairs += len(of_camera.Fs)
        if method != WITHOUT_MATCHES and all(name in found.evidence for name in ANSWER):
            found = replace(found, K=camera_matrix(*(found.evidence[name] for name in ANSWER)))
        cameras |= {Path(image.name).stem: found for image in images}
    return MethodResult(method, cameras, seconds, pairs)


def run_rivals(subject: MatchedSet) -> Iterator[MethodResult]:
    """Run COLMAP's view-graph calibration and PoseLib's iterated focals."""
    images, fits = subject.matches.images, len(subject.views.fits)
    database = subject.out / "database.db"
    calibrated = rivals.view_graph_calibration(database, subject.out, subject.matches, subject.views)
    iterated = rivals.iterated_focals(subject.matches, subject.views)
    for method, (found, seconds) in ((rivals.VIEW_GRAPH, calibrated), (rivals.ITERATED, iterated)):
        cameras = {Path(images[key].name).stem: camera for key, camera in found.items()}
        yield MethodResult(method, cameras, seconds, fits)


def run_every_method(
    subject: MatchedSet, methods: Sequence[str], others: Mapping[str, Mapping[str, object]]
) -> Iterator[MethodResult]:
    """Run all methods; the production one under its own settings and under each of the others."""
    yield run_production(subject)
    for label, overrides in others.items():
        yield run_production(subject, overrides, f"{PRODUCTION}, {label}")
    yield from run_rivals(subject)
    for method in (WITHOUT_MATCHES, *(name for name in methods if name != PRODUCTION)):
        yield run_calibrator(subject, method)


def adjusted_cameras(subject: MatchedSet) -> dict[str, TrueCamera]:
    """Return the cameras of our own bundle adjustment: a reference where there is no truth."""
    run = sfm_app.reconstruct(subject.photos.folder, subject.out, subject.settings, last="scene")
    refined = run.scene.cameras if run.scene else {}
    return {
        Path(image.name).stem: TrueCamera(refined[image.group].K, _first_radial_term(refined[image.group]))
        for image in subject.matches.images.values()
        if image.group in refined
    }


def _first_radial_term(camera: CameraModel) -> float:
    return float(camera.params[3 if camera.model == "SIMPLE_RADIAL" else 4])


def warm_up() -> None:
    """Compile the kernels by one unmeasured call of every calibrator."""
    tracks = make_tracks(TrackOptions(cameras=4), seed=0)
    inliers = tuple(np.hstack([view.x1, view.x2]) for view in tracks.pairs.values())
    pairs = CameraPairs(tracks.F, np.ones(len(tracks.F)), tracks.size, tuple(tracks.pairs), inliers)
    for calibrator in load_plugins().calibrators.values():
        calibrator.calibrate(pairs, Settings().calibration, 0)
