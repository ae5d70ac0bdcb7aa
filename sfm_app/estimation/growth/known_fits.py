"""Wide lenses and fundamental matrices of an earlier run."""

from collections.abc import Collection, Mapping

from sfm_app.runtime.earlier import Earlier
from sfm_app.types import Calibration, EpipolarFit, MatchedImage, MatchGraph, PairId, Rejected, ViewGraph

LEAST_KNOWN = 0.5
"""Share of the photos of a camera group that an earlier run must have seen for what it found of the camera to stay: by
definition, most of them."""


def mostly_known_groups(matches: MatchGraph, earlier: Earlier) -> dict[str, tuple[list[MatchedImage], int]]:
    """Return the camera groups most of whose photos are known: their photos, and how many of these are known.

    Args:
        matches: all photos.
        earlier: what an earlier run left behind.
    """
    groups: dict[str, list[MatchedImage]] = {}
    for _, image in sorted(matches.images.items()):
        groups.setdefault(image.group, []).append(image)
    counts = {group: sum(image.name in earlier.known for image in images) for group, images in groups.items()}
    return {
        group: (images, counts[group]) for group, images in groups.items() if counts[group] > LEAST_KNOWN * len(images)
    }


def known_lenses(matches: MatchGraph, before: ViewGraph, earlier: Earlier) -> dict[str, Calibration | None]:
    """Return what was found of the lenses of camera groups that are mostly known: wide ones, None for the usual ones.

    Args:
        matches: all photos.
        before: view graph of the earlier run.
        earlier: what that left behind.
    """
    return {group: before.lenses.get(group) for group in mostly_known_groups(matches, earlier)}


def known_fits(
    matches: MatchGraph, before: ViewGraph, same: Collection[PairId], lenses: Mapping[str, Calibration]
) -> dict[PairId, tuple[EpipolarFit | Rejected, int]]:
    """Return the fits of pairs with the same matches and the same lenses; their stationary matches are not counted.

    Args:
        matches: all photos.
        before: view graph of the earlier run.
        same: pairs whose matches are the same.
        lenses: of this run, by camera group.
    """
    groups = {image.group for image in matches.images.values()}
    unchanged = {group for group in groups if _text(before.lenses.get(group)) == _text(lenses.get(group))}
    every: dict[PairId, EpipolarFit | Rejected] = {**before.fits, **before.rejected}
    return {
        pair: (every[pair], 0)
        for pair in same
        if pair in every and all(matches.images[photo].group in unchanged for photo in pair)
    }


def _text(lens: Calibration | None) -> str:
    return "" if lens is None else str(lens.to_dict())
