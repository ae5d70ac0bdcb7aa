"""Reasons why photos have no pose."""

from collections.abc import Iterator, Sequence

from sfm_app.types import MatchGraph, PoseGraph, ViewGraph

MANY, FEW_LOST = 60, 0.05
"""In sets of at least this many photos, a smaller share of unregistered ones is not worth another reconstruction."""


def are_worth_another_try(lost: int, photos: int) -> bool:
    """Return whether photos without a place justify mapping all of them once more.

    Args:
        lost: photos without a place.
        photos: photos of the set.
    """
    return lost > 0 and (photos < MANY or lost >= FEW_LOST * photos)


def unregistered_reasons(
    posed: set[int], others: Sequence[Sequence[int]], matches: MatchGraph, views: ViewGraph, graph: PoseGraph
) -> dict[str, str]:
    """Return why each photo is missing in the main model, by name.

    Args:
        posed: photos of the main model.
        others: photos of each of the other models.
        matches: all photos.
        views: fundamental matrices.
        graph: consistent relative poses, and why others were dropped.
    """
    reasons = {}
    for photo, image in matches.images.items():
        if photo not in posed:
            model = next((model for model in others if photo in model), None)
            if model:
                reasons[image.name] = f"belongs to another model, of {len(model)} photos"
            elif not len(matches.keypoints[photo]):
                reasons[image.name] = "no features were found in it"
            else:
                reasons[image.name] = _reason(photo, posed, views, graph)
    return reasons


def _reason(photo: int, posed: set[int], views: ViewGraph, graph: PoseGraph) -> str:
    edges = dict(_edges(photo, views))
    to_posed = {other: count for other, count in edges.items() if other in posed}
    if to_posed:
        nearest = max(to_posed, key=lambda other: (to_posed[other], -other))
        contradiction = graph.dropped.get((min(photo, nearest), max(photo, nearest)))
        because = f", but that pair was dropped: {contradiction}" if contradiction else ""
        return f"could not be placed: {to_posed[nearest]} inliers with the nearest placed photo{because}"
    return (
        "shares inliers only with photos that have no place either" if edges else "shares no scene with any other photo"
    )


def _edges(photo: int, views: ViewGraph) -> Iterator[tuple[int, int]]:
    for pair, fit in views.fits.items():
        if photo in pair:
            yield pair[pair[0] == photo], fit.inlier_count


def photo_names(photos: Sequence[int], matches: MatchGraph) -> list[str]:
    """Return the names of photos.

    Args:
        photos: ids.
        matches: knows the names.
    """
    return [matches.images[photo].name for photo in photos]
