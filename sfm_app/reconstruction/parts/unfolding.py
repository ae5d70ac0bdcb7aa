"""Map a part of a group, and again where its model has two places in one.

The sides of a false join may hang together in other parts only, so each is a model of its own then.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from sfm_app.posegraph.groups import connected_groups
from sfm_app.reconstruction.look_alikes import drop_look_alikes, with_false_joins
from sfm_app.reconstruction.mapping_runs import ENOUGH_SHARE, Attempt, Group, best_attempt, map_group
from sfm_app.reconstruction.overlaid.false_joins import MOST_FALSE_JOINS, judge_places
from sfm_app.runtime.context import RunContext
from sfm_app.types import LookAlikes

LEAST_PHOTOS = 3
"""Smallest model that is worth joining: of two photos, nothing tells the scale."""


@dataclass(frozen=True, slots=True, eq=False)
class UnfoldedPart:
    """What became of a part."""

    models: tuple[Attempt, ...]
    """Of each connected piece that was mapped, the largest first."""
    tried: tuple[str, ...]
    """Notes on all attempts, for people."""
    false_joins: tuple[LookAlikes, ...] = ()
    """Pairs that held one place on top of another; the models are without them."""

    @property
    def photos(self) -> int:
        """Number of posed photos."""
        return sum(model.photos for model in self.models)


def map_unfolded(part: Group, follow: Callable[[Group], None], run: RunContext) -> UnfoldedPart:
    """Return models of a part without false joins.

    A rival without the pairs of a false join is taken if it places most of the photos, and leaves at most half of the
    strangers, as for models of whole groups.

    Args:
        part: connected photos, with their matches, geometry and cameras.
        follow: makes the mappers follow the pairs of a group; called for every rival, and by the caller for the part.
        run: the run.
    """
    best = _map_pieces(part, run)
    joins, strangers = judge_places(best.models)
    while joins and len(best.false_joins) < MOST_FALSE_JOINS:
        rival_part = hide_false_joins(part, joins)
        follow(rival_part)
        rival = _map_pieces(rival_part, run)
        left, strangers_left = judge_places(rival.models)
        if rival.photos < ENOUGH_SHARE * best.photos or 2 * strangers_left > strangers:
            return replace(best, tried=(*best.tried, *rival.tried))
        found = (*best.false_joins, *joins)
        best, part = UnfoldedPart(rival.models, (*best.tried, *rival.tried), found), rival_part
        joins, strangers = left, strangers_left
    return best


def hide_false_joins(group: Group, joins: Sequence[LookAlikes]) -> Group:
    """Return a group whose matches, geometry and pose graph lack the pairs of false joins.

    Args:
        group: connected photos.
        joins: found in its model, or in those of its parts.
    """
    graph = with_false_joins(group.graph, joins)
    matches, views = drop_look_alikes(group.matches, group.views, graph)
    return replace(group, matches=matches, views=views, graph=graph)


def _map_pieces(part: Group, run: RunContext) -> UnfoldedPart:
    """Map the connected pieces of a part, each on its own."""
    models, tried = list[Attempt](), list[str]()
    pieces = [sorted(piece) for piece in connected_groups(part.graph.poses) if len(piece) >= LEAST_PHOTOS]
    for photos in pieces if len(pieces) > 1 else [part.photos]:
        found = map_group(replace(part, photos=tuple(photos)), run)
        tried += [one.note for one in found]
        best = best_attempt(found)
        models += [best] if best is not None else []
    return UnfoldedPart(tuple(sorted(models, key=lambda one: (-one.photos, -one.support))), tuple(tried))
