"""Match the pairs that probably show the same place, in two rounds."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.descriptors import largest_descriptors
from sfm_app.estimation.feature_parts import read_pixels
from sfm_app.estimation.growth.same_matches import pairs_with_news
from sfm_app.estimation.matching import match_pairs
from sfm_app.estimation.pairing import LARGEST_FEATURES, first_pairs, second_pairs
from sfm_app.numerical import Json
from sfm_app.plugins import FeatureMethod
from sfm_app.retrieval.picture_features import describe_picture
from sfm_app.runtime.context import RunContext
from sfm_app.types import MatchedImage, MatchGraph


def match_probable_pairs(method: FeatureMethod, load: Callable[[], MatchGraph], run: RunContext) -> dict[str, Json]:
    """Match pairs of photos that look alike or lie beside each other, then pairs that these suggest.

    Pairs of photos that an earlier run has seen keep the matches that they have.

    Args:
        method: of matching; features are known.
        load: reads the match graph as it is now.
        run: the run.

    Returns:
        The options in force, for the manifest.

    Raises:
        PluginError: the method raises, or returns invalid results.
        BackendError: COLMAP failed.
    """
    before = load()
    known = run.earlier.known if run.earlier is not None else frozenset[str]()
    news = {photo for photo, image in before.images.items() if image.name not in known}
    if not news:  # photos were only taken away
        run.record(matched_pairs=0, rounds=[0, 0])
        return {}
    first = first_pairs(before.images, lambda photo: _descriptors(method, before.images[photo], run), run, news)
    first = pairs_with_news(first, before.images, known)
    in_force = match_pairs(method, run, first)
    seen, asked = load(), set(first)
    asked |= seen.matches.keys() - set(pairs_with_news(seen.matches, before.images, known))
    matches = {pair: rows for pair, rows in seen.matches.items() if pair in asked}
    counts = {photo: len(points) for photo, points in seen.keypoints.items()}
    second = second_pairs(counts, matches, asked, run.settings.matching, news)
    in_force |= match_pairs(method, run, second)
    run.record(matched_pairs=len(first) + len(second), rounds=[len(first), len(second)])
    return in_force


def _descriptors(method: FeatureMethod, image: MatchedImage, run: RunContext) -> NDArray[np.uint8]:
    """Return descriptors of the largest features of a photo: its own where they are SIFT, else those of its picture."""
    if method.sift is None:
        return describe_picture(read_pixels(run.workspace.photos / image.name), LARGEST_FEATURES)
    with translate_errors("reading features"):
        return largest_descriptors(run.workspace.database, image.id, LARGEST_FEATURES)
