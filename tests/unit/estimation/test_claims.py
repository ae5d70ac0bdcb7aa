"""Claims of EXIF, plug-ins and files about cameras, and those that the photos contradict."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sfm_app.camera.models import camera_matrix
from sfm_app.errors import ConfigError, PluginError
from sfm_app.estimation.claims import Claim, claim, find_priors, refined_claims, report_claims
from sfm_app.plugins import CameraPriorMethod, hookimpl, load_plugins
from sfm_app.progress import Progress
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.types import (
    Calibration,
    CameraModel,
    CameraPrior,
    GivenCameras,
    Intrinsics,
    MatchedImage,
    MatchGraph,
    Scene,
)


def exif(focal):
    return CameraPrior("EXIF", focal, 0.04 * focal)


def matched(key, prior=None, **values):
    return MatchedImage(key, f"{key}.jpg", "a", 1000, 800, prior, **values)


def camera(focal=1850.0, deviation=20.0, center=(500.0, 400.0), **values):
    spread = {"fx": deviation, "cx": 3.0, "cy": 3.0}
    return Calibration(camera_matrix(focal, focal, *center), 1000, 800, "zero-curves", True, spread=spread, **values)


def test_a_claim_is_the_median_of_the_photos_inside_their_bars():
    photos = [matched(1, exif(1200.0)), matched(2, exif(1210.0)), matched(3), matched(4, exif(9000.0))]
    found = claim(photos, camera())
    assert (found.prior.focal_px, found.photos) == (1210.0, 3)
    assert claim([matched(1)], camera()) is None
    assert claim([matched(1, exif(1200.0), shown=(0, 0, 500, 800))], camera()).prior.focal_px == 960.0


@pytest.mark.parametrize(
    ("claimed", "deviation", "contradicted"),
    [(1200.0, 20.0, True), (1720.0, 2.0, False), (1200.0, 300.0, False), (2900.0, 20.0, True)],
)
def test_a_claim_may_be_rounded_and_photos_may_be_unsure(claimed, deviation, contradicted):
    assert Claim(exif(claimed), 3, camera(deviation=deviation)).is_contradicted == contradicted


@pytest.mark.parametrize(
    ("x", "held", "contradicted"), [(505.0, (), False), (560.0, (), True), (560.0, ("center",), False)]
)
def test_a_claimed_center_is_contradicted_where_the_photos_determine_it(x, held, contradicted):
    found = Claim(CameraPrior("a net", 1850.0, 90.0, (x, 400.0), 10.0), 3, camera(held=held))
    assert found.is_contradicted == contradicted and ("center" in found.text) == contradicted
    assert not Claim(CameraPrior("a net", 1850.0, 90.0), 3, camera(center=(560.0, 400.0))).is_contradicted


@pytest.mark.parametrize(
    "values", [(0.0, 9.0), (900.0, 0.0), (np.nan, 9.0), (900.0, 9.0, (np.inf, 1.0), 9.0), (9.0, 9.0, (1.0, 1.0))]
)
def test_a_claim_without_a_camera_or_a_deviation_is_none(values):
    with pytest.raises(ValueError, match="finite"):
        CameraPrior("a net", *values)


class Said(Progress):
    """Progress that keeps what is said."""

    def __init__(self):
        self.lines = []

    def say(self, text):
        self.lines.append(text)


def test_only_contradicted_claims_are_said_and_all_are_recorded(tmp_path):
    run = RunContext(Settings(), Workspace(tmp_path), load_plugins(), None, 1, Said())
    report_claims(
        {"a": Claim(exif(1200.0), 3, camera()), "b": Claim(exif(900.0), 2, camera(905.0, 5.0)), "c": None}, run
    )
    assert run.progress.lines == [
        "the photos a: EXIF says 1200 px, the photos say 1850 +- 20 px: they were cropped or zoomed"
    ]
    recorded = run.statistics["camera_claims"]
    assert [recorded[name]["contradicted"] for name in ("a", "b")] == [True, False] and "c" not in recorded
    silent = replace(run, statistics={})
    report_claims({"c": None}, silent)
    assert silent.statistics == {}


def test_bundle_adjustment_judges_claims_that_pairs_could_not_judge():
    K = camera_matrix(1850.0, 1850.0, 500.0, 400.0)
    refined = CameraModel("OPENCV", (1850.0, 1850.0, 500.0, 400.0, 0, 0, 0, 0), K, 1000, 800, {"fx": 10.0})
    scene = Scene(None, {"1.jpg": np.eye(3, 4)}, {}, {"a": refined}, 9, 9, 0.3, {"1.jpg": "a"})
    matches = MatchGraph({1: matched(1, exif(1200.0)), 2: matched(2, exif(99.0))}, {}, {})
    unknown = Calibration(K, 1000, 800, "claim", False, "an orbit")
    (found,) = refined_claims(scene, Intrinsics({"a": unknown}), matches).values()
    assert found.prior.focal_px == 1200.0 and found.is_contradicted
    assert refined_claims(scene, Intrinsics({"a": replace(unknown, identifiable=True)}), matches) == {}


# Plug-ins and files.


def network(find):
    class Network:
        @hookimpl
        def sfm_camera_priors(self):
            return [CameraPriorMethod("a-net", find)]

    return load_plugins([Network()], installed=False)


@pytest.fixture
def laid_out(tmp_path):
    """Returns two photos, of which the second is on its side, and a run with plug-ins and settings."""
    place = Workspace(tmp_path / "out")
    place.create()
    place.photos.mkdir(exist_ok=True)
    picture = np.zeros((60, 80, 3), np.uint8)
    picture[10, 70] = 255
    images = {}
    for key, (name, turn) in enumerate((("a.png", 0), ("b.png", 90)), start=1):
        images[key] = MatchedImage(key, name, "one", 80, 60, exif(77.0), turn_deg=turn)
        Image.fromarray(picture).save(place.photos / name)
    with make_executor(1) as executor:
        yield lambda plugins, **settings: (
            MatchGraph(images, {}, {}), RunContext(Settings(**settings), place, plugins, executor, 1)
        )  # fmt: skip


def bright_center(picture):
    """Claims that the center is at the bright pixel."""
    y, x = np.argwhere(picture[..., 0] > 0)[0]
    return CameraPrior("a net", 1.5 * max(picture.shape), 9.0, (x + 0.5, y + 0.5), 2.0)


def test_a_plug_in_sees_upright_photos_and_comes_before_exif(laid_out):
    sizes = []
    matches, run = laid_out(network(lambda picture: sizes.append(picture.shape) or bright_center(picture)))
    found = find_priors(matches, run)
    assert sorted(sizes) == [(60, 80, 3), (80, 60, 3)]
    assert found.keys() == {"a.png", "b.png"}
    assert {one.prior.focal_px for one in matches.with_priors(found).images.values()} == {120.0}


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_a_center_returns_to_the_orientation_of_the_sensor(laid_out, turn):
    matches, run = laid_out(network(bright_center))
    turned = replace(matches, images={key: replace(one, turn_deg=turn) for key, one in matches.images.items()})
    assert {one.center_px for one in find_priors(turned, run).values()} == {(70.5, 10.5)}


def test_without_an_answer_or_a_method_exif_remains(laid_out):
    for plugins, name in ((network(lambda _: None), "auto"), (network(bright_center), "none")):
        matches, run = laid_out(plugins, calibration={"priors": name})
        assert find_priors(matches, run) == {}
        assert {one.prior.focal_px for one in matches.with_priors({}).images.values()} == {77.0}
    with pytest.raises(ConfigError, match="another-net"):
        find_priors(*laid_out(network(bright_center), calibration={"priors": "another-net"}))


def test_a_failing_plug_in_is_named_with_the_photo(laid_out):
    with pytest.raises(PluginError, match=r"'a-net' failed on a.png: ValueError: .* finite"):
        find_priors(*laid_out(network(lambda _: CameraPrior("a net", np.nan, 1.0))))


@pytest.mark.parametrize("known", [{}, {"fx": 4.0, "cx": 1.0, "cy": 2.0, "k1": 0.01}])
def test_a_file_that_may_be_off_claims_what_it_states_deviations_of(laid_out, known):
    matches, run = laid_out(network(bright_center), calibration={"deviation": 0.02})
    given = replace(camera(150.0, center=(41.0, 29.0), distortion=(-0.1,)), width=80, height=60, method="given")
    given = GivenCameras({"one": replace(given, spread=known)}, {}, "a file", "x")
    found = find_priors(matches, replace(run, given=given))
    for one in found.values():
        assert (one.focal_px, one.focal_deviation_px) == (150.0, pytest.approx(5.0 if known else 3.0))
        assert (one.center_px, one.k1) == (((41.0, 29.0), -0.1) if known else (None, None))
    intrinsics = Intrinsics({}, priors=found)
    assert Intrinsics.from_dict(json.loads(json.dumps(intrinsics.to_dict()))).priors == found
