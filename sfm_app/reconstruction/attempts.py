"""COLMAP's two mappers on one group of photos, side by side, and the better of what they made."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from sfm_app.colmap.backend import backend, interruptible
from sfm_app.colmap.mapping import map_globally, map_incrementally
from sfm_app.colmap.model import model_from_seed
from sfm_app.context import RunContext
from sfm_app.reconstruction.left_out import names_of
from sfm_app.reconstruction.seeds import Candidate, rank_seeds, seed_of
from sfm_app.reconstruction.support import Explained, explained_pairs, support
from sfm_app.types import Intrinsics, MatchGraph, PairId, PoseGraph, ViewGraph

ENOUGH = 0.9
"""A model with this share of its group ends the search for a better seed."""
CONFIRMED = 0.5
"""So does this share when two seeds agree on how many photos can be placed."""
LEAST_GLOBAL = 3
"""Photos: of two, positions have no scale to agree on."""
EQUAL = 0.01
"""Models that explain as many matches but for this share count as equal; of them, the one with most points is taken."""

Maker = Callable[[Any], Any]
"""What makes a model, or None, until a token stops it."""


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Photos that hang together, and all that is known about them."""

    photos: Sequence[int]
    matches: MatchGraph
    views: ViewGraph
    graph: PoseGraph
    intrinsics: Intrinsics


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """What a mapper made of a group, and what it explains."""

    mapper: str
    model: Any
    """COLMAP's reconstruction; None where there is none, or one with too few points."""
    explained: dict[PairId, Explained]
    note: str
    """For people: how it was made, and how many photos it holds."""

    @property
    def photos(self) -> int:
        """Photos with a pose."""
        return int(self.model.num_reg_images()) if self.model is not None else 0

    @property
    def support(self) -> float:
        """See `support.support`."""
        return support(self.explained)


def attempts(group: Group, run: RunContext) -> list[Attempt]:
    """What the mappers of the settings make of a group.

    Photo by photo from the best seed and all at once, side by side; where neither places most photos, from the next
    seeds. What is tried never depends on which mapper is done first.
    """
    options = run.settings.scene
    at_once = options.mapper != "incremental" and len(group.photos) >= LEAST_GLOBAL
    seeds = rank_seeds(group.matches, group.graph, group.intrinsics, group.photos, options.min_seed_angle_deg)
    seeds = seeds[: options.seed_pairs] if options.mapper != "global" or not at_once else []
    todo: list[tuple[str, str, Maker]] = [_from_seed(group, candidate, run) for candidate in seeds]
    first = ([_all_at_once(group, run)] if at_once else []) + todo[:1]
    found = _judged(group, first, run)
    for maker in todo[1:]:
        if _settled(found, len(group.photos)):
            break
        found += _judged(group, [maker], run)
    best = better(found)
    if best is not None and best.mapper == "global" and best.photos < len(group.photos):
        found += _judged(group, [_from_model(best.model, run)], run)
    return found


def better(found: Sequence[Attempt]) -> Attempt | None:
    """The attempt that explains most matches; of equal ones, the one with most photos and points."""
    models = [attempt for attempt in found if attempt.model is not None]
    most = max((attempt.support for attempt in models), default=0.0)
    equal = [attempt for attempt in models if attempt.support >= (1.0 - EQUAL) * most]
    return max(equal, key=lambda attempt: (attempt.photos, attempt.model.num_points3D()), default=None)


def _settled(found: Sequence[Attempt], photos: int) -> bool:
    """Whether another seed is unlikely to give more."""
    counts = [attempt.photos for attempt in found if attempt.photos]
    most = max(counts, default=0)
    return most >= ENOUGH * photos or (counts.count(most) > 1 and most >= CONFIRMED * photos)


def _judged(group: Group, makers: Sequence[tuple[str, str, Maker]], run: RunContext) -> list[Attempt]:
    """What each maker gives, made side by side, in the order of the makers."""
    models: list[Any] = []

    def call(token: Any) -> None:
        with ThreadPoolExecutor(min(run.workers, len(makers)), thread_name_prefix="mapper") as pool:
            models.extend(pool.map(lambda maker: maker[2](token), makers))

    with backend("mapping photos"):
        if makers:
            run.progress.start("mapping", len(makers) * max(len(group.photos) - 2, 1))
            try:
                interruptible(call, lambda: None)
            finally:
                run.progress.finish()
        return [
            _attempt(group, mapper, how, model, run) for (mapper, how, _), model in zip(makers, models, strict=True)
        ]


def _attempt(group: Group, mapper: str, how: str, model: Any, run: RunContext) -> Attempt:
    placed = int(model.num_reg_images()) if model is not None else 0
    note = f"{how}: {placed} photos"
    if placed < 2 or model.num_points3D() < run.settings.scene.min_points:
        return Attempt(mapper, None, {}, note)
    explained = explained_pairs(model, group.matches, group.views, run.settings.epipolar.max_error_px)
    return Attempt(mapper, model, explained, note)


def _all_at_once(group: Group, run: RunContext) -> tuple[str, str, Maker]:
    place, names = run.workspace, names_of(group.photos, group.matches)

    def make(token: Any) -> Any:
        model = map_globally(place.database, place.photos, names, place.root / ".global", run.seed, token)
        run.progress.advance(max(len(names) - 2, 1))
        return model

    return "global", "all at once", make


def _from_seed(group: Group, candidate: Candidate, run: RunContext) -> tuple[str, str, Maker]:
    def make(token: Any) -> Any:
        rows = group.matches.matches[candidate.pair][candidate.pose.inliers]
        seed = seed_of(group.matches, candidate, group.intrinsics)
        return _grown(model_from_seed(run.workspace.database, candidate.pair, rows, seed), run, token)

    return "incremental", f"from {' + '.join(names_of(candidate.pair, group.matches))}", make


def _from_model(model: Any, run: RunContext) -> tuple[str, str, Maker]:
    """Photos that the global mapper left out may fit into what it made."""
    return "incremental", "what was left out, photo by photo", lambda token: _grown(model, run, token)


def _grown(start: Any, run: RunContext, token: Any) -> Any:
    place = run.workspace
    scratch = place.root / ".mapping"
    return map_incrementally(place.database, place.photos, start, scratch, run.seed, run.progress.advance, token)
