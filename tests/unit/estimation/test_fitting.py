"""Wide lenses of camera groups: found, described, and left alone where a perspective camera is enough."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.camera.bearings import project, radius_px
from sfm_app.camera.projection import Fisheye
from sfm_app.errors import ConfigError
from sfm_app.estimation.calibrating import find_intrinsics
from sfm_app.estimation.fitting import describe_lens, find_lenses, ray_estimator, to_calibration
from sfm_app.plugins import load_plugins
from sfm_app.products import read_view_graph
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.selfcal.wide_lens import LensEstimate
from sfm_app.settings import Settings
from sfm_app.stages import view_graph
from sfm_app.types import Calibration, GivenCameras, MatchedImage, MatchGraph, RayFit, Rejected

SIZE = (960, 640)
K = np.array([[270.0, 0.0, 485.0], [0.0, 270.0, 316.0], [0.0, 0.0, 1.0]])
WIDE = Calibration(K, *SIZE, "truth", True, projection="fisheye", distortion=(0.0,))
PLAIN = Calibration(np.array([[900.0, 0, 480], [0, 900, 320], [0, 0, 1]]), *SIZE, "truth", True)


def photos_through(camera, photos=5, group="960x640", first=1, away=4.0):
    rng = np.random.default_rng(first)
    X = rng.normal(size=(500, 3)) * [4.0, 2.0, 2.0] + [0.0, 0.0, away]
    keypoints, images = {}, {}
    for key in range(first, first + photos):
        turn = Rotation.from_euler("xyz", rng.normal(0.0, 0.15, 3)).as_matrix()
        x = project((X - rng.normal(0.0, 0.7, 3)) @ turn.T, camera)
        outside = ~((x > 0) & (x < SIZE)).all(axis=1)
        x[outside] = rng.uniform((0, 0), SIZE, (int(outside.sum()), 2))
        keypoints[key] = x + rng.normal(0.0, 0.4, x.shape)
        images[key] = MatchedImage(key, f"{key}.jpg", group, *SIZE)
    rows = np.tile(np.arange(500, dtype=np.uint32)[:, None], 2)
    pairs = {(a, b): rows for a in images for b in images if a < b}
    return MatchGraph(images, keypoints, pairs)


@pytest.fixture
def run(tmp_path):
    with make_executor(2) as executor:
        yield RunContext(Settings(), Workspace(tmp_path), load_plugins(), executor, 2, fingerprint="these")


@pytest.mark.slow
def test_a_fisheye_is_found_before_fundamental_matrices_and_becomes_the_camera(run):
    matches = photos_through(WIDE)
    views = view_graph.make(matches, run)
    intrinsics = find_intrinsics(matches, views, run)

    assert run.statistics["lenses"] == {"960x640": "a fisheye with 204 degrees along the longer side"}
    assert read_view_graph(run.workspace).lenses["960x640"].to_dict() == views.lenses["960x640"].to_dict()
    camera = intrinsics.main
    assert (camera.projection, camera.method, camera.identifiable) == ("fisheye", "lens", True)
    theta = np.linspace(0.1, 1.6, 20)
    assert np.abs(radius_px(theta, camera) - 270.0 * theta).max() < 0.003 * SIZE[0]
    assert all(fit.inlier_count > 200 for fit in views.fits.values())


@pytest.mark.slow
def test_a_perspective_camera_is_left_to_the_calibrators(run):
    views = view_graph.make(photos_through(PLAIN, away=14.0), run)
    assert not views.lenses and run.statistics["lenses"] == {}


def given(run, camera, **settings):
    """The run with a camera that the user gave for all photos."""
    known = GivenCameras({"": replace(camera, method="given")}, source="a file", digest="x")
    return replace(run, given=known, settings=Settings.from_mapping(settings))


@pytest.mark.slow
def test_a_given_fisheye_takes_the_place_of_the_one_that_is_found_and_is_checked(run):
    matches = photos_through(WIDE)
    right = given(run, replace(WIDE, K=WIDE.K + np.diag([0.5, 0.5, 0.0])), calibration={"keep": True})
    lens = find_lenses(matches, right)["960x640"]

    assert lens.is_kept and lens.focal_px == 270.5
    assert run.statistics["given_cameras"]["960x640"] == {
        "from": "a file", "kept": True, "checked": True, "contradicted": []
    }  # fmt: skip
    views = view_graph.make(matches, right)
    intrinsics = find_intrinsics(matches, views, right)
    assert intrinsics.main.is_kept and intrinsics.main.focal_px == 270.5
    wrong = given(run, replace(WIDE, K=WIDE.K * [[1.1], [1.1], [1.0]]))
    assert find_lenses(matches, wrong)["960x640"].method == "given"
    [said] = run.statistics["given_cameras"]["960x640"]["contradicted"][:1]
    assert said["what"] == "focal length" and abs(said["found_px"] - 270.0) < 3.0


@pytest.mark.slow
def test_a_given_perspective_camera_is_used_and_contradicted_where_the_lens_is_a_fisheye(run):
    matches, wrong = photos_through(WIDE), given(run, PLAIN)
    assert find_lenses(matches, wrong) == {}
    [said] = [one for one in run.statistics["given_cameras"]["960x640"]["contradicted"] if "fisheye" in one["what"]]
    assert said["given_px"] > 1.5 * said["found_px"]


@pytest.mark.slow
def test_a_given_perspective_camera_is_checked_by_the_calibrator(run):
    matches = photos_through(PLAIN, 6, away=14.0)
    wrong = given(run, replace(PLAIN, K=PLAIN.K * [[1.2], [1.2], [1.0]]))
    views = view_graph.make(matches, wrong)
    intrinsics = find_intrinsics(matches, views, wrong)
    assert [(name, camera.method) for name, camera in intrinsics.cameras.items()] == [("960x640", "given")]
    assert intrinsics.main.focal_px == pytest.approx(1080.0)
    [said] = run.statistics["given_cameras"]["960x640"]["contradicted"][:1]
    assert said["what"] == "focal length" and said["found_px"] == pytest.approx(900.0, rel=0.02)


@pytest.mark.slow
def test_the_name_of_a_model_says_whether_the_lens_is_wide(run):
    matches = photos_through(WIDE)
    perspective = replace(run, settings=Settings.from_mapping({"scene": {"camera_model": "OPENCV"}}))
    fisheye = replace(run, settings=Settings.from_mapping({"scene": {"camera_model": "RADIAL_FISHEYE"}}))
    assert find_lenses(matches, perspective) == {}
    assert find_lenses(photos_through(PLAIN, away=14.0), fisheye)["960x640"].projection == "fisheye"


def test_only_panoramas_can_be_panoramas(run):
    panoramic = replace(run, settings=Settings.from_mapping({"scene": {"camera_model": "EQUIRECTANGULAR"}}))
    with pytest.raises(ConfigError, match=r"5 photos are not panoramas, such as 1\.jpg"):
        find_lenses(photos_through(PLAIN), panoramic)


@pytest.mark.parametrize("exponent", [0.5, 0.2, 0.0, -0.5])
def test_four_terms_describe_every_lens_of_the_family(exponent):
    lens = Fisheye(480.0 / float(Fisheye(1.0, exponent).radius(np.radians(87.0))), exponent, (481.0, 322.0))
    estimate = LensEstimate(lens, tuple(map(tuple, (np.eye(4) * 1e-8).tolist())), 0.9, 0.4, 12, SIZE)
    camera = to_calibration(estimate, SIZE)
    theta = np.linspace(0.0, np.radians(87.0), 100)
    assert np.abs(radius_px(theta, camera) - lens.radius(theta)).max() < 0.05
    assert camera.identifiable and "174 degrees" in describe_lens(camera)


def test_a_lens_that_pairs_hardly_determine_is_an_estimate():
    loose = tuple(map(tuple, np.diag([0.1, 0.5, 1.0, 1.0]).tolist()))
    camera = to_calibration(LensEstimate(Fisheye(300.0, 0.0, (480.0, 320.0)), loose, 0.9, 0.4, 12, SIZE), SIZE)
    assert (camera.identifiable, camera.method) == (False, "estimate") and camera.reason


def test_pairs_of_a_wide_lens_and_another_camera_are_fitted_by_rays():
    wide, plain = MatchedImage(1, "1.jpg", "wide", *SIZE), MatchedImage(2, "2.jpg", "plain", *SIZE)
    assert ray_estimator([plain, plain], {"wide": WIDE}) is None
    fit = ray_estimator([wide, plain], {"wide": WIDE})
    matches = photos_through(WIDE, 2)
    assert fit is not None and isinstance(fit(*matches.points((1, 2)), Settings().epipolar, 0), (RayFit, Rejected))
    both = ray_estimator([wide, wide], {"wide": WIDE})
    assert both is not None and isinstance(both(*matches.points((1, 2)), Settings().epipolar, 0), RayFit)
