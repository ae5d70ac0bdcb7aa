"""Look-alikes that were recognized: hide their matches from mapping, and report them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.models.model import posed_images
from sfm_app.colmap.types import Reconstruction
from sfm_app.numerical import Json
from sfm_app.posegraph.graph import LOOKS_ALIKE
from sfm_app.reconstruction.unregistered import photo_names
from sfm_app.types import LookAlikes, MatchGraph, PairId, PoseGraph, ViewGraph

LEAST_IN_ORDER = 30
"""Number of photos below which their order is no evidence: temple16 is numbered in two arcs."""
JUMP, MOST_JUMPS = 5.0, 0.1
"""Length of a jump, in median steps; with a larger share of jumps the photos count as unordered. Not chosen on any set;
the usual order of castle-P19, fountain-P11, Herz-Jesus-P8, kitti51 and oats23 has no jump."""


def drop_look_alikes(matches: MatchGraph, views: ViewGraph, graph: PoseGraph) -> tuple[MatchGraph, ViewGraph]:
    """Return matches and fundamental matrices without those of look-alikes.

    Pairs of look-alikes are evidence neither for a model nor against it.

    Args:
        matches: keypoints and raw matches.
        views: fundamental matrices.
        graph: knows the pairs of look-alikes.
    """
    gone = {pair for join in graph.look_alikes for pair in join.pairs}
    if not gone:
        return matches, views
    kept = {pair: rows for pair, rows in matches.matches.items() if pair not in gone}
    fits = {pair: fit for pair, fit in views.fits.items() if pair not in gone}
    return replace(matches, matches=kept), replace(views, fits=fits)


def with_earlier_look_alikes(graph: PoseGraph, earlier: PoseGraph) -> PoseGraph:
    """Return a pose graph with the look-alikes of an earlier pass added to its own.

    Args:
        graph: pose graph of this pass.
        earlier: pose graph of the pass before it.
    """
    dropped = {pair: earlier.dropped[pair] for join in earlier.look_alikes for pair in join.pairs}
    return replace(graph, dropped=dropped | dict(graph.dropped), look_alikes=earlier.look_alikes + graph.look_alikes)


def with_false_joins(graph: PoseGraph, joins: Sequence[LookAlikes]) -> PoseGraph:
    """Return a pose graph without the pairs of look-alikes that a model showed.

    Args:
        graph: pose graph of the pass that made the model.
        joins: pairs that hold one place on top of another.
    """
    gone = {pair for join in joins for pair in join.pairs}
    kept = {pair: pose for pair, pose in graph.poses.items() if pair not in gone}
    return replace(
        graph,
        poses=kept,
        dropped=dict(graph.dropped) | dict.fromkeys(sorted(gone), LOOKS_ALIKE),
        look_alikes=(*graph.look_alikes, *joins),
    )


def look_alike_entries(joins: Sequence[LookAlikes], matches: MatchGraph) -> list[dict[str, Json]]:
    """Return the recognized look-alikes, for the manifest.

    Args:
        joins: pairs of look-alikes, grouped by the places that they confuse.
        matches: knows the photos' names.
    """
    return [
        {
            "pairs": len(join.pairs),
            "between": [photo_names(photos, matches) for photos in sides(join.pairs, matches)],
            "missing": round(join.missing, 3),
        }
        for join in joins
    ]


def jumps(model: Reconstruction) -> list[list[str]]:
    """Return successive photos, by name, that are much farther apart than others: a video may be folded there.

    Empty where many steps are long, because the photos are then unordered. A jump is no proof: videos may be cut, too.
    """
    with translate_errors("reading poses"):
        placed = sorted((image.name, image.projection_center()) for image in posed_images(model))
    if len(placed) < LEAST_IN_ORDER:
        return []
    steps = np.linalg.norm(np.diff([center for _, center in placed], axis=0), axis=1)
    long = np.flatnonzero(steps > JUMP * np.median(steps))
    return [[placed[k][0], placed[k + 1][0]] for k in long] if len(long) <= MOST_JUMPS * len(steps) else []


def sides(pairs: Sequence[PairId], matches: MatchGraph) -> tuple[list[int], list[int]]:
    """Return the photos at either place: each pair, those with most matches first, puts its photos on opposite sides.

    Args:
        pairs: look-alikes; at least one.
        matches: raw matches of these pairs.
    """
    counts = {pair: len(matches.matches[pair]) for pair in pairs}
    here: set[int] = set()
    there: set[int] = set()
    waiting = sorted(pairs, key=lambda pair: (-counts[pair], pair))
    while waiting:
        known = here | there
        a, b = next((pair for pair in waiting if not known.isdisjoint(pair)), waiting[0])
        waiting.remove((a, b))
        if a in there or b in here:
            a, b = b, a
        if a not in known:
            here.add(a)
        if b not in known:
            there.add(b)
    return sorted(here), sorted(there)
