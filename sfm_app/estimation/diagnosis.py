"""Diagnosis of photos that give no scene: one sentence and a hint, from the counts of the early stages.

Pairs are classified one by one (see `ransac.degeneracy`, `ransac.stationary`), some of them wrongly. Here they vote,
weighted by their inliers: a set is a panorama when most of its inliers are in pairs classified as rotations.
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
from sfm_app.types import MatchedImage, MatchGraph, PairId, ViewGraph

Cause = Literal["copies", "texture", "logo", "nothing", "rotation", "planar", "collinear", "unclear"]

NOTHING_MATCHED = ViewGraph({}, {})
"""The view graph where no two photos have matches."""

MAX_PX_PER_FEATURE = 800.0
"""Pixels per feature above which a photo shows hardly any texture: sensor noise on a white wall gives one per 1100 or
more, the poorest real photos one per 630."""
PLANE_PHOTOS = 3
"""Photos of a plane from which a parameter of the camera follows: m views of an unknown plane give 2 m equations for
the plane's 4 unknowns and those of the camera (Triggs 1998)."""
LEAST_PARALLAX = 0.01
"""Share of all inliers that has to show parallax. Misclassified panoramas have 0.2 % (mismatches), frames of
a video that hardly moves 15 %."""

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
    """One line."""

    @property
    def hint(self) -> str:
        """What to do, one line."""
        return HINTS[self.cause]

    def error(self, details: str = "") -> ReconstructionError:
        """Make the error that ends the run."""
        return ReconstructionError(f"{self.message}; {details}" if details else self.message, hint=self.hint)


def diagnose_scene(matches: MatchGraph, views: ViewGraph, options: MatchSettings) -> Diagnosis:
    """Return the main reason why photos cannot be reconstructed.

    Args:
        matches, views: all photos with their matches; fits and rejections of the pairs, empty without matches.
        options: settings with which features were found.
    """
    if views.fits:
        return diagnose_fits(views, set(matches.images))
    photos = len(matches.images)
    reasons = Counter(views.reasons)
    twins = {pair for pair, rejected in views.rejected.items() if rejected.reason == SAME_PHOTO}
    if twins and len(connected_groups(twins, matches.images)) == 1:
        return Diagnosis("copies", f"{photos} copies of one photo, or nearly")
    counts = sorted(len(points) for points in matches.keypoints.values())
    features = f"{counts[0]} to {counts[-1]} features per photo" if counts[-1] else "no features"
    bare = [_pixels_per_feature(image, matches, options.max_image_size_px) for image in matches.images.values()]
    if median(bare) > MAX_PX_PER_FEATURE:
        return Diagnosis("texture", f"hardly any texture: {features}, and no two photos have enough in common")
    if reasons[ONLY_A_LOGO] > reasons.total() / 2:
        return Diagnosis("logo", f"the photos have {ONLY_A_LOGO}")
    seen = ", ".join([f"{count} pairs: {reason}" for reason, count in reasons.items()] or ["no pair has a match"])
    return Diagnosis("nothing", f"the {photos} photos show nothing in common ({features}; {seen})")


def diagnose_depth(
    matches: MatchGraph, views: ViewGraph, photos: Collection[int], options: EpipolarSettings, *, camera_known: bool
) -> Diagnosis | None:
    """Return why a model of these photos could be wrong with small residuals; None where they have parallax.

    Pairs without parallax fit any epipole, and with a wrong K a rotation looks like parallax. A plane leaves F
    undetermined but not E: it can be reconstructed if the camera is known, or calibrated from enough photos of it.

    Args:
        matches: all photos and their matches.
        views: fits and rejections of the pairs.
        photos: ids of those in the model.
        options: settings with which the pairs were fitted.
        camera_known: whether K rests on more than a guess.
    """
    kinds = inliers_by_degeneracy(views, photos)
    if kinds[""] >= kinds.total() / 2:
        return None
    firm = [pair for pair in _pairs_among(views, photos) if not views.fits[pair].degeneracy]
    parallax = sum(_count_parallax(pair, matches, views, options) for pair in firm)
    if parallax >= LEAST_PARALLAX * kinds.total():
        return None
    found = diagnose_fits(views, photos)
    by_plane = found.cause == "planar" and (camera_known or len(photos) >= PLANE_PHOTOS)
    return None if by_plane else found


def _count_parallax(pair: PairId, matches: MatchGraph, views: ViewGraph, options: EpipolarSettings) -> int:
    """Return the inliers of a pair off its dominant plane; with a known lens all, since no plane is degenerate then."""
    if any(matches.images[photo].group in views.lenses for photo in pair):
        return views.fits[pair].inlier_count
    return count_matches_off_plane(*matches.points(pair), views.fits[pair].F, options)


def inliers_by_degeneracy(views: ViewGraph, photos: Collection[int]) -> Counter[str]:
    """Count the inliers of the pairs among some photos by degeneracy, "" where F is determined.

    Args:
        views: fundamental matrices.
        photos: ids; both photos of a pair have to be among them.
    """
    found: Counter[str] = Counter()
    for pair in _pairs_among(views, photos):
        found[views.fits[pair].degeneracy] += views.fits[pair].inlier_count
    return found


def diagnose_fits(views: ViewGraph, photos: Collection[int]) -> Diagnosis:
    """Return why the fitted pairs among some photos do not allow a reconstruction.

    Args:
        views: fundamental matrices.
        photos: ids; at least one pair among them has a fit.
    """
    kinds, pairs = inliers_by_degeneracy(views, photos), _pairs_among(views, photos)
    if kinds[""] < kinds.total() / 2:
        kind = max(DEGENERATE, key=lambda kind: kinds[kind])
        named = sum(views.fits[pair].degeneracy == kind for pair in pairs)
        return Diagnosis(kind, f"{DEGENERATE[kind]} ({named} of {len(pairs)} pairs)")
    inliers = sorted(views.fits[pair].inlier_count for pair in pairs)
    rejected = "".join(f", {count} rejected: {reason}" for reason, count in views.reasons.items())
    seen = f"{len(pairs)} pairs with {inliers[0]} to {inliers[-1]} inliers{rejected}"
    return Diagnosis("unclear", f"no pair of photos grows into a model ({seen})")


def _pairs_among(views: ViewGraph, photos: Collection[int]) -> list[PairId]:
    members = set(photos)
    return [pair for pair in views.fits if members.issuperset(pair)]


def _pixels_per_feature(image: MatchedImage, matches: MatchGraph, feature_side_px: int) -> float:
    shrunk = min(1.0, feature_side_px / max(image.width, image.height))
    return image.width * image.height * shrunk**2 / max(1, len(matches.keypoints[image.id]))
