"""Wide lenses of camera groups, given or from raw matches: before them, no fundamental matrix fits."""

import logging
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ConfigError
from sfm_app.estimation.camera_check import report_checks
from sfm_app.estimation.given_cameras import assign_cameras
from sfm_app.geometry.camera import camera_matrix, panorama_matrix
from sfm_app.geometry.lenses.camera_models import projection_of_model
from sfm_app.geometry.lenses.lens_curve import SHARES, deviation_key, field_of_view_deg
from sfm_app.numerical import FAILURES
from sfm_app.runtime.context import RunContext
from sfm_app.selfcal.wide_angle.lens_search import LensEstimate, find_lens, needs_fisheye, shows_whole_turn
from sfm_app.types import Calibration, MatchedImage, MatchGraph
from sfm_app.types.calibration import EQUIRECTANGULAR, FISHEYE

logger = logging.getLogger("sfm_app")

FloatArray = NDArray[np.float64]

METHOD, PANORAMA = "lens", "panorama"
"""Names of what found a camera: curved epipolar lines, and the photos themselves."""
MAX_DEVIATION = 0.01
"""Largest standard deviation of a radius, as a share of the width, of a lens that counts as determined. Chosen by
hand; not measured on its own."""
TERMS, ANGLES = 4, 200
"""Terms of COLMAP's OPENCV_FISHEYE, and angles at which they are fitted. Counted; chosen by hand."""
NONE_DECIDED: Mapping[str, Calibration | None] = MappingProxyType({})
"""No lens is known from an earlier run."""


def find_lenses(
    matches: MatchGraph, run: RunContext, decided: Mapping[str, Calibration | None] = NONE_DECIDED
) -> dict[str, Calibration]:
    """Find the cameras whose lens no perspective camera describes, by camera group.

    Those that the user gave are taken, and checked against what the matches say.

    Args:
        matches: keypoints and raw matches.
        run: the run.
        decided: wide lenses that an earlier run found, by camera group; None where it found that there is none.

    Raises:
        InputError: the calibration file fits no photo.
        ConfigError: the photos are no panoramas, as the user says.
    """
    _check_panoramas(matches, run)
    given = assign_cameras(matches, run.given, keep=run.settings.calibration.keep)
    if given.notes:
        run.record(given_camera_notes=list(given.notes))
    for note in given.notes:
        run.progress.say(note)
    groups: dict[str, list[MatchedImage]] = {}
    for _, image in sorted(matches.images.items()):
        groups.setdefault(image.group, []).append(image)
    found, checked = {}, {}
    for group, images in groups.items():
        known = given.cameras.get(group)
        if known is not None:
            checked[group] = known, _seen_lens(known, images, matches, run)
            lens = known if known.projection == FISHEYE else None
        else:
            lens = decided[group] if group in decided else _find_lens(images, matches, run)
        if lens is not None:
            found[group] = lens
            run.progress.say(f"the photos {group} are taken with a wide lens: {describe_lens(lens)}")
    report_checks(checked, run)
    run.record(lenses={group: describe_lens(lens) for group, lens in found.items()})
    return found


def describe_lens(lens: Calibration) -> str:
    """Return a wide lens in a few words."""
    if lens.projection == EQUIRECTANGULAR:
        return "panoramas of a whole turn"
    return f"a fisheye with {max(field_of_view_deg(lens)):.0f} degrees along the longer side"


def _find_lens(images: Sequence[MatchedImage], matches: MatchGraph, run: RunContext) -> Calibration | None:
    """Return the camera of a group with a wide lens; None where a perspective camera is enough."""
    size = images[0].width, images[0].height
    if images[0].projection == EQUIRECTANGULAR:
        return panorama(size)
    model = run.settings.scene.camera_model
    if model != "auto":
        asked = projection_of_model(model) == FISHEYE
        return _search_lens(images, matches, run, is_wide=True) if asked else None
    return _search_lens(images, matches, run, is_wide=False) if run.settings.calibration.lens else None


def panorama(size: tuple[int, int]) -> Calibration:
    """Return the camera of panoramas.

    Args:
        size: (width, height) in pixels.
    """
    nothing_open = dict.fromkeys(("fx", "fy", "cx", "cy"), 0.0)
    K = panorama_matrix(size)
    return Calibration(K, *size, PANORAMA, identifiable=True, projection=EQUIRECTANGULAR, spread=nothing_open)


def _seen_lens(
    known: Calibration, images: Sequence[MatchedImage], matches: MatchGraph, run: RunContext
) -> Calibration | None:
    """Return what the matches of a group with a given camera say of its lens; None where they say nothing.

    Of a given perspective camera, they only say something where the lens is a fisheye.
    """
    if not run.settings.calibration.lens:
        return None
    return _search_lens(images, matches, run, is_wide=known.projection == FISHEYE)


def _search_lens(
    images: Sequence[MatchedImage], matches: MatchGraph, run: RunContext, *, is_wide: bool
) -> Calibration | None:
    """Return the lens that the raw matches of a group show; None where there is none, or a perspective one is enough.

    Where it is known to be wide, the best one is returned whether or not it is better than a perspective one.
    """
    size, ids = (images[0].width, images[0].height), {image.id for image in images}
    pairs = [np.hstack(matches.points(pair)) for pair in matches.matches if ids.issuperset(pair)]
    try:
        if not is_wide and shows_whole_turn(pairs, size, run.seed):
            return panorama(size)
        found = find_lens(pairs, size, run.seed) if is_wide or needs_fisheye(pairs, size, run.seed) else None
    except FAILURES as err:
        logger.info("the lens of a group could not be found", exc_info=err)
        return None
    return to_calibration(found, size) if found is not None and (is_wide or found.is_fisheye) else None


def _check_panoramas(matches: MatchGraph, run: RunContext) -> None:
    """Check that photos are panoramas where the user says so: no other photo can be one."""
    others = [image.name for image in matches.images.values() if image.projection != EQUIRECTANGULAR]
    if run.settings.scene.camera_model == "EQUIRECTANGULAR" and others:
        raise ConfigError(
            f"{len(others)} photos are no panoramas, such as {others[0]}",
            hint="leave --camera-model EQUIRECTANGULAR out; panoramas are recognized without it",
        )


def to_calibration(found: LensEstimate, size: tuple[int, int]) -> Calibration:
    """Return a lens as the camera that a run uses, with its radius as a polynomial of the angle.

    Args:
        found: the lens in pixels.
        size: (width, height) of the photos.
    """
    lens, side = found.lens, float(max(size))
    corners = np.array([[x, y] for x in (0.0, size[0]) for y in (0.0, size[1])], np.float64)
    farthest = float(np.max(np.hypot(*(corners - np.array(lens.center)).T)))
    theta = np.linspace(0.0, float(lens.angle(np.array([farthest]))[0]), ANGLES + 1)[1:]
    powers = theta[:, None] ** (2.0 * np.arange(1, TERMS + 1) + 1.0)
    terms = np.linalg.lstsq(powers, lens.radius(theta) / lens.focal - theta, rcond=None)[0]
    deviations = np.sqrt(np.diag(np.array(found.covariance)))
    radius_px = float(np.max(found.radius_deviation_px(theta)))
    determined = radius_px <= MAX_DEVIATION * side
    focal_px = float(deviations[0]) * lens.focal
    evidence = {
        "pairs": float(found.pairs), "exponent": lens.exponent, "field_deg": lens.field_deg(side),
        "support": found.support, "support of a perspective lens": found.perspective_support,
        "radius_deviation_px": radius_px,
    } | {deviation_key(share): float(found.radius_deviation_px(share * theta[-1:])[0]) for share in SHARES}  # fmt: skip
    return Calibration(
        camera_matrix(lens.focal, lens.focal, *lens.center), *size, METHOD if determined else "estimate",
        identifiable=determined,
        reason="" if determined else "the pairs determine the lens only roughly",
        projection=FISHEYE,
        fisheye=tuple(terms.tolist()),
        spread={"fx": focal_px, "fy": focal_px, "cx": float(deviations[2]), "cy": float(deviations[3])},
        held=("aspect",),
        evidence=evidence,
    )  # fmt: skip
