"""EXIF's focals are compared with what the photos determine, and never win."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.estimation.given_cameras import FocalClaim, focal_claim, refined_claims, report_claims
from sfm_app.plugins import load_plugins
from sfm_app.progress import SilentProgress
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.types import Calibration, CameraModel, Intrinsics, MatchedImage, MatchGraph, Scene


def photo(key, focal=None, **values):
    return MatchedImage(key, f"{key}.jpg", "a", 1000, 800, focal, **values)


def test_a_claim_is_the_median_of_the_photos_inside_their_bars():
    claim = focal_claim([photo(1, 1200.0), photo(2, 1210.0), photo(3), photo(4, 9000.0)], 1850.0, 20.0)

    assert (claim.claimed_px, claim.photos) == (1210.0, 3)
    assert focal_claim([photo(1)], 1850.0, 20.0) is None
    assert focal_claim([photo(1, 1200.0, shown=(0, 0, 500, 800))], 9.0, 9.0).claimed_px == 960.0


@pytest.mark.parametrize(
    ("claimed", "deviation", "contradicted"),
    [(1200.0, 20.0, True), (1720.0, 2.0, False), (1200.0, 300.0, False), (2900.0, 20.0, True)],
)
def test_a_claim_may_be_rounded_and_photos_may_be_unsure(claimed, deviation, contradicted):
    assert FocalClaim(claimed, 3, 1850.0, deviation).is_contradicted == contradicted


def test_the_text_has_both_numbers_and_what_happened():
    assert FocalClaim(1200.0, 3, 1850.0, 20.0).text == (
        "EXIF says 1200 px, the photos say 1850 +- 20: they were cropped or zoomed"
    )
    assert "through another lens" in FocalClaim(1850.0, 3, 1200.0, 20.0).text


class Said(SilentProgress):
    """Progress that keeps what is said."""

    def __init__(self):
        self.lines = []

    def say(self, text):
        self.lines.append(text)


def test_only_contradicted_claims_are_said_and_all_are_recorded(tmp_path):
    run = RunContext(Settings(), Workspace(tmp_path), load_plugins(), None, 1, Said())
    report_claims({"a": FocalClaim(1200.0, 3, 1850.0, 20.0), "b": FocalClaim(900.0, 2, 905.0, 5.0), "c": None}, run)

    assert run.progress.lines == [
        "the photos a: EXIF says 1200 px, the photos say 1850 +- 20: they were cropped or zoomed"
    ]
    recorded = run.statistics["exif_focals"]
    assert [recorded[name]["contradicted"] for name in ("a", "b")] == [True, False] and "c" not in recorded
    silent = replace(run, statistics={})
    report_claims({"c": None}, silent)
    assert silent.statistics == {}


def test_bundle_adjustment_judges_claims_that_pairs_could_not_judge():
    K = camera_matrix(1850.0, 1850.0, 500.0, 400.0)
    refined = CameraModel("OPENCV", (1850.0, 1850.0, 500.0, 400.0, 0, 0, 0, 0), K, 1000, 800, {"fx": 10.0})
    scene = Scene(None, {"1.jpg": np.eye(3, 4)}, {}, {"a": refined}, 9, 9, 0.3, {"1.jpg": "a"})
    matches = MatchGraph({1: photo(1, 1200.0), 2: photo(2, 99.0)}, {}, {})
    unknown = Calibration(K, 1000, 800, "exif", False, "an orbit")

    assert refined_claims(scene, Intrinsics({"a": unknown}), matches)["a"].claimed_px == 1200.0
    assert refined_claims(scene, Intrinsics({"a": replace(unknown, identifiable=True)}), matches) == {}
