"""The sky of photos: where there is no surface, however well its rims agree."""

from sfm_app.stereo.sky.areas import PhotoAreas, blank_areas
from sfm_app.stereo.sky.outline import near_pixels, sky_pixels
from sfm_app.stereo.sky.voting import Votes, count_votes, find_skies, spread_partners

__all__ = [
    "PhotoAreas",
    "Votes",
    "blank_areas",
    "count_votes",
    "find_skies",
    "near_pixels",
    "sky_pixels",
    "spread_partners",
]
