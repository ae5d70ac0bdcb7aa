"""Diagnosis of photos that give no scene: one sentence and a hint, from the counts of the early stages.

Pairs are classified one by one (`fundamental.degeneracy`), some of them wrongly. Here they vote, weighted by their
inliers: a set is a panorama when most of its inliers are in pairs classified as rotations.
"""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from statistics import median
from typing import Literal

from sfm_app.errors import ReconstructionError
from sfm_app.fundamental.degeneracy import ONLY_A_LOGO, SAME_PHOTO
from sfm_app.fundamental.estimate import count_matches_off_plane
from sfm_app.posegraph.rotations import connected_groups
from sfm_app.settings import EpipolarSettings, MatchSettings
from sfm_app.types import EpipolarFit, MatchedImage, MatchGraph, PairId, ViewGraph

Cause = Literal["copies", "texture", "logo", "nothing", "rotation", "planar", "collinear", "unclear"]

NOTHING_MATCHED = ViewGraph({}, {})
"""View graph without matches."""


class OPTIONS:
    """Limits of a diagnosis."""

    max_px_per_feature: float = 800.0
    """Pixels per feature above which a photo shows hardly any texture. Measured: white walls 1100, poorest photos
    630."""
    plane_photos: int = 3
    """Photos of a plane that determine a parameter of the camera (Triggs 1998): 2 m equations for 4 unknowns."""
    min_parallax: float = 0.01
    """Share of all inliers that must show parallax. Measured: misclassified panoramas 0.2 %, slow videos 15 %."""


STEP = "take each photo from another place, a step or two from the last"
OVERLAP = "take photos of one place that overlap by more than half"
HINTS: dict[Cause, str] = {
    "copies": STEP,
    "texture": "plain surfaces show nothing to match: take in things with texture, sharp and in good light",
    "logo": OVERLAP,
    "nothing": OVERLAP,
    "rotation": f"{STEP}: turning on the spot is not enough",
    "planar": "take photos that show things before and behind the plane, or at least three of the plane from the sides",
    "collinear": OVERLAP,
    "unclear": f"photos that overlap more may help; {STEP}",
}

DEGENERATE: dict[Cause, str] = {
    "rotation": "the camera only turned: photos from one spot hold no depth",
    "planar": "everything lies in one plane",
    "collinear": "all that the photos have in common lies on one line",
}
"""Descriptions of the degeneracies that leave F undetermined."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Why there is no scene."""

    cause: Cause
    message: str

    @property
    def hint(self) -> str:
        """What to do, one line."""
        return HINTS[self.cause]

    def error(self, details: str = "") -> ReconstructionError:
        """Make the error that ends the run."""
        return ReconstructionError(f"{self.message}; {details}" if details else self.message, hint=self.hint)


def diagnose_scene(matches: MatchGraph, views: ViewGraph, options: MatchSettings) -> Diagnosis:
    """Return the main reason why photos cannot be reconstructed; `views` is empty without matches."""
    if views.fits:
        return diagnose_fits(views, set(matches.images))
    photos = len(matches.images)
    reasons = Counter(views.reasons)
    copies = {pair for pair, rejected in views.rejected.items() if rejected.reason == SAME_PHOTO}
    if copies and len(connected_groups(copies, matches.images)) == 1:
        return Diagnosis("copies", f"{photos} copies of one photo, or nearly")
    counts = sorted(len(points) for points in matches.keypoints.values())
    features = f"{counts[0]} to {counts[-1]} features per photo" if counts[-1] else "no features"
    densities = [_pixels_per_feature(image, matches, options.max_image_size_px) for image in matches.images.values()]
    if median(densities) > OPTIONS.max_px_per_feature:
        return Diagnosis("texture", f"hardly any texture: {features}, and no two photos have enough in common")
    if reasons[ONLY_A_LOGO] > reasons.total() / 2:
        return Diagnosis("logo", f"the photos have {ONLY_A_LOGO}")
    causes = ", ".join([f"{count} pairs: {reason}" for reason, count in reasons.items()] or ["no pair has a match"])
    return Diagnosis("nothing", f"the {photos} photos show nothing in common ({features}; {causes})")


def diagnose_depth(
    matches: MatchGraph, views: ViewGraph, photos: Collection[int], options: EpipolarSettings, *, camera_known: bool
) -> Diagnosis | None:
    """Return why a model of these photos could be wrong with small residuals; None where they have parallax.

    Pairs without parallax fit any epipole, and with a wrong K a rotation looks like parallax. A plane leaves F
    undetermined but not E: it can be reconstructed if the camera is known, or calibrated from enough photos of it.
    """
    kinds = inliers_by_degeneracy(views, photos)
    if kinds[""] >= kinds.total() / 2:
        return None
    determined = {pair: views.fits[pair] for pair in _pairs_among(views, photos) if not views.fits[pair].degeneracy}
    # with a known lens, no plane is degenerate
    parallax = sum(
        count_matches_off_plane(*matches.points(pair), fit.F, options)
        if isinstance(fit, EpipolarFit)
        else fit.inlier_count
        for pair, fit in determined.items()
    )
    if parallax >= OPTIONS.min_parallax * kinds.total():
        return None
    diagnosis = diagnose_fits(views, photos)
    by_plane = diagnosis.cause == "planar" and (camera_known or len(photos) >= OPTIONS.plane_photos)
    return None if by_plane else diagnosis


def inliers_by_degeneracy(views: ViewGraph, photos: Collection[int]) -> Counter[str]:
    """Count the inliers of the pairs among some photos by degeneracy, "" where F is determined."""
    counts: Counter[str] = Counter()
    for pair in _pairs_among(views, photos):
        counts[views.fits[pair].degeneracy] += views.fits[pair].inlier_count
    return counts


def diagnose_fits(views: ViewGraph, photos: Collection[int]) -> Diagnosis:
    """Return why the fitted pairs among some photos do not allow a reconstruction; at least one has a fit."""
    kinds, pairs = inliers_by_degeneracy(views, photos), _pairs_among(views, photos)
    if kinds[""] < kinds.total() / 2:
        kind = max(DEGENERATE, key=lambda kind: kinds[kind])
        degenerate = sum(views.fits[pair].degeneracy == kind for pair in pairs)
        return Diagnosis(kind, f"{DEGENERATE[kind]} ({degenerate} of {len(pairs)} pairs)")
    inliers = sorted(views.fits[pair].inlier_count for pair in pairs)
    rejected = "".join(f", {count} rejected: {reason}" for reason, count in views.reasons.items())
    summary = f"{len(pairs)} pairs with {inliers[0]} to {inliers[-1]} inliers{rejected}"
    return Diagnosis("unclear", f"no pair of photos grows into a model ({summary})")


def _pairs_among(views: ViewGraph, photos: Collection[int]) -> list[PairId]:
    members = set(photos)
    return [pair for pair in views.fits if members.issuperset(pair)]


def _pixels_per_feature(image: MatchedImage, matches: MatchGraph, feature_side_px: int) -> float:
    shrunk = min(1.0, feature_side_px / max(image.width, image.height))
    return image.width * image.height * shrunk**2 / max(1, len(matches.keypoints[image.id]))
