"""The methods of this package as a plug-in."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from sfm_app.formats import EXPORTERS, SCENE_EXPORTERS
from sfm_app.formats.exporters import Exporter, SceneExporter
from sfm_app.fundamental import ESTIMATORS
from sfm_app.plugins import CPU, SIFT, SIFT_AFFINE, Calibrator, DepthMethod, Estimator, FeatureMethod, hookimpl
from sfm_app.selfcal import CALIBRATORS, SEVERAL_CAMERAS
from sfm_app.types import Rejected

if TYPE_CHECKING:  # OpenCV, which stereo needs, takes longer to load than an estimator to run
    from sfm_app.stereo.view import DepthTask


SIFT_AFFINE_SUMMARY = "COLMAP's SIFT, slower: affine shape, fainter features; for plain things"
SIFT_AFFINE_OPTIONS = {"estimate_affine_shape": True, "peak_threshold": 0.0007}
"""A tenth of COLMAP's contrast. Chosen on dinoSparseRing, half of whose neighbors have no match with COLMAP's own."""


def _make_depth_maps_on_cpu(task: "DepthTask") -> list[Rejected | None]:
    from sfm_app.stereo import make_depth_maps_on_cpu

    return make_depth_maps_on_cpu(task)


@hookimpl
def sfm_estimators() -> Iterable[Estimator]:
    """Return the estimators of fundamental matrices."""
    return [Estimator(name, fit, summary) for name, (fit, summary) in ESTIMATORS.items()]


@hookimpl
def sfm_calibrators() -> Iterable[Calibrator]:
    """Return the calibrators."""
    return [
        Calibrator(name, calibrate, summary, together=name == SEVERAL_CAMERAS)
        for name, (calibrate, summary) in CALIBRATORS.items()
    ]


@hookimpl
def sfm_features() -> Iterable[FeatureMethod]:
    """Return COLMAP's SIFT, with and without affine shape."""
    return [
        FeatureMethod(SIFT, summary="COLMAP's SIFT", sift={}),
        FeatureMethod(SIFT_AFFINE, summary=SIFT_AFFINE_SUMMARY, sift=SIFT_AFFINE_OPTIONS),
    ]


@hookimpl
def sfm_exporters() -> Iterable[Exporter]:
    """Return the file formats for models."""
    return EXPORTERS.values()


@hookimpl
def sfm_scene_exporters() -> Iterable[SceneExporter]:
    """Return the formats for cameras, poses, points and photos."""
    return SCENE_EXPORTERS.values()


@hookimpl
def sfm_depth_methods() -> Iterable[DepthMethod]:
    """Return the depth method of the CPU."""
    return [DepthMethod(CPU, _make_depth_maps_on_cpu, "semi-global matching and PatchMatch, on every machine")]
