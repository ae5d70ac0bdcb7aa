"""Map a large group in parts: the steps in order, and when their model is as good as one of the whole group."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from sfm_app.colmap.backend import run_in_daemon_thread, translate_errors
from sfm_app.colmap.joined_model import adjust_joined, read_placed, write_placed
from sfm_app.errors import BackendError
from sfm_app.mapping.attempt import (
    Attempt,
    Group,
    MappingResult,
    NoModel,
    are_worth_another_try,
    best_attempt,
    complete_attempt,
    is_well_known,
    judge_model,
    photo_names,
)
from sfm_app.mapping.joins import (
    AcrossJoins,
    Alignment,
    Fragment,
    Join,
    JoinError,
    align_fragments,
    find_join,
    loop_errors,
    merge_fragments,
)
from sfm_app.mapping.part_mapping import Part, PartResult, cut_group, map_parts, remove_parts
from sfm_app.numerical import FAILURES, Json, error_reason
from sfm_app.runtime.context import RunContext
from sfm_app.settings import SceneSettings
from sfm_app.types import Calibration, LookAlikes, PairId, PoseGraph

logger = logging.getLogger("sfm_app")

MAPPER = "parts"
MOST_WHOLE, USUAL_PART = 400, 150
"""Photos up to which a group is mapped as a whole, and photos of a part above."""
LEAST_PART = 20
"""Smallest part that a user can ask for: smaller ones consist of shared photos."""
MOST_CONTRADICTED = 0.05
"""Share of the inliers of fundamental matrices that may contradict a model of parts, before the whole is mapped, too:
as for a rival."""
LEAST_SUPPORTED = 16
"""Number of matches across a join below which these decide nothing, as of a pair."""


@dataclass(frozen=True, slots=True, eq=False)
class JoinedParts:
    """Models of parts, and how they were joined."""

    parts: tuple[Part, ...]
    results: tuple[PartResult, ...]
    fragments: tuple[Fragment, ...]
    alignment: Alignment
    refused: tuple[Join, ...]
    """Joins that more matches contradict than support."""


def part_size(photos: int, options: SceneSettings) -> int:
    """Return the photos of a part; 0 where a group is mapped as a whole.

    Args:
        photos: number of photos in the group.
        options: settings of the scene.
    """
    if options.part_photos:
        size = max(LEAST_PART, options.part_photos)
        return size if photos > 1.5 * size else 0
    return USUAL_PART if photos > MOST_WHOLE else 0


def map_in_parts(
    group: Group, mapped: PoseGraph, run: RunContext, *, asked: bool = True
) -> tuple[list[MappingResult], tuple[LookAlikes, ...]]:
    """Return the results of mapping a group in parts; or else the false joins within parts, which are then not joined.

    A group of one part gives neither.

    Args:
        group: a connected group of photos, with their matches and poses.
        mapped: the pose graph with the pairs that mapping follows; it is in the run's database.
        run: the run.
        asked: whether parts are asked for false joins.
    """
    parts = cut_group(group.graph, group.photos, part_size(len(group.photos), run.settings.scene))
    if len(parts) < 2:
        return [], ()
    photos = len(group.photos)
    run.progress.say(f"{photos} photos are mapped in {len(parts)} parts of {_range([len(p.photos) for p in parts])}")
    try:
        results = map_parts(group, parts, mapped, run, asked=asked)
        joins = merge_false_joins([join for result in results for join in result.false_joins])
        if joins and asked:
            return [], joins
        joined = join_parts(group, parts, results, run)
        found = _merge(group, joined, run)
    except (BackendError, *FAILURES) as err:  # the whole may still be mapped
        logger.info("parts were not joined", exc_info=err)
        return [NoModel(MAPPER, f"in {len(parts)} parts: failed, {error_reason(err)}")], ()
    best = best_attempt(found)
    if best is not None and best.photos < photos:
        found += [replace(one, mapper=MAPPER) for one in complete_attempt(group, best, run)]
    run.record(parts=[*run.statistics.get("parts", []), part_figures(group, joined, found)])
    remove_parts(run)
    return found, ()


def merge_false_joins(joins: Sequence[LookAlikes]) -> tuple[LookAlikes, ...]:
    """Return false joins of several parts, each pair in one of them: parts share photos, and may share a join.

    Args:
        joins: of all parts.
    """
    seen, found = set[PairId](), list[LookAlikes]()
    for join in joins:
        fresh = tuple(pair for pair in join.pairs if pair not in seen)
        seen.update(fresh)
        found += [replace(join, pairs=fresh)] if fresh else []
    return tuple(found)


def _range(counts: Sequence[int]) -> str:
    low, high = min(counts), max(counts)
    return str(low) if low == high else f"{low} to {high}"


def is_convincing(found: Sequence[MappingResult], photos: int) -> bool:
    """Return whether a model of parts makes mapping of the whole group needless.

    Args:
        found: results of `map_in_parts`.
        photos: number of photos in the group.
    """
    best = best_attempt(found)
    if best is None or are_worth_another_try(photos - best.photos, photos):
        return False
    inliers = sum(pair.inliers for pair in best.explained.values())
    return sum(pair.contradicted for pair in best.explained.values()) <= MOST_CONTRADICTED * inliers


def join_parts(group: Group, parts: Sequence[Part], results: Sequence[PartResult], run: RunContext) -> JoinedParts:
    """Find the joins between the models of all parts, and a common frame without wrong ones.

    Args:
        group: all photos, with their matches and geometry.
        parts: of its photos.
        results: of mapping each part.
        run: the run.
    """
    fragments = [
        Fragment(number, frozenset(part.own), read_placed(Path(folder)))
        for number, (part, result) in enumerate(zip(parts, results, strict=True))
        for folder in result.models
    ]
    # pairs that the pose graph has dropped, as those of look-alikes, are evidence neither for a join nor against it
    sound = {pair: fit for pair, fit in group.views.fits.items() if pair in group.graph.poses}
    across = AcrossJoins(group.matches, replace(group.views, fits=sound), run.settings.epipolar.max_error_px)
    kept: list[Join] = []
    refused: list[Join] = []
    for first, second in combinations(range(len(fragments)), 2):
        join = find_join(first, second, fragments)
        if join is None:
            continue
        explained, contradicted = across.count(join, fragments)
        join = replace(join, explained=explained, contradicted=contradicted)
        wrong = contradicted > max(explained, LEAST_SUPPORTED)
        (refused if wrong else kept).append(join)
    return JoinedParts(tuple(parts), tuple(results), tuple(fragments), align_fragments(fragments, kept), tuple(refused))


def _merge(group: Group, joined: JoinedParts, run: RunContext) -> list[MappingResult]:
    """Return the model of all joined fragments, adjusted together."""
    count = len(joined.parts)
    if not joined.fragments:
        reasons = sorted({note for result in joined.results for note in result.tried})
        return [NoModel(MAPPER, f"in {count} parts: none was mapped; {'; '.join(reasons[:3])}")]
    placed = merge_fragments(joined.fragments, joined.alignment.frames)
    database = run.workspace.database
    free = {
        photo for photo in placed.photos.tolist() if not _is_held(group.intrinsics.camera(group.matches.images[photo]))
    }
    with translate_errors("joining parts"), run.step("adjusting all parts together"):
        model = write_placed(database, placed)
        refined = sorted({model.images[photo].camera_id for photo in free})
        run_in_daemon_thread(lambda: adjust_joined(model, database, refined))
    how = f"in {count} parts, {len(joined.alignment.kept)} joins"
    return [judge_model(group.matches, group.views, (MAPPER, how), model, run)]


def _is_held(camera: Calibration) -> bool:
    return camera.is_kept or is_well_known(camera)


def part_figures(group: Group, joined: JoinedParts, found: Sequence[MappingResult]) -> dict[str, Json]:
    """Return the manifest's figures about the parts of a group.

    Args:
        group: all photos.
        joined: models of parts and their joins.
        found: models of all.
    """
    aligned = joined.alignment
    loops = loop_errors(joined.fragments, [join for join, _ in (*aligned.kept, *aligned.dropped)])
    return {
        "parts": _part_entries(group, joined),
        "joins": [_join_entry(join, joined, off) for join, off in aligned.kept],
        "dropped_joins": [
            *(_join_entry(join, joined, off) | {"because": "contradicts other joins"} for join, off in aligned.dropped),
            *(_join_entry(join, joined) | {"because": "matches contradict it"} for join in joined.refused),
        ],
        "loops": [{"through": [joined.fragments[k].part for k in way]} | _error_entry(off) for way, off in loops],
        "left_out": [joined.fragments[k].part for k in range(len(joined.fragments)) if k not in aligned.frames],
        "models": [one.note for one in found if isinstance(one, Attempt)],
    }


def _part_entries(group: Group, joined: JoinedParts) -> list[Json]:
    placed = [(fragment.part, len(fragment.placed.photos)) for fragment in joined.fragments]
    return [
        {
            "photos": len(part.photos),
            "own": len(part.own),
            "first": photo_names(part.own[:1], group.matches)[0],
            "placed": [count for owner, count in placed if owner == number],
            "mapper": result.mapper,
            "tried": list(result.tried),
        }
        for number, (part, result) in enumerate(zip(joined.parts, joined.results, strict=True))
    ]


def _join_entry(join: Join, joined: JoinedParts, off: JoinError | None = None) -> dict[str, Json]:
    known: dict[str, Json] = {
        "between": [joined.fragments[join.first].part, joined.fragments[join.second].part],
        "photos": join.photos,
        "shared": join.shared,
        "points": join.points,
        "deviation_deg": round(join.off_deg, 3),
        "deviation": round(join.off, 4),
        "explained": join.explained,
        "contradicted": join.contradicted,
    }
    return known if off is None else known | _error_entry(off)


def _error_entry(off: JoinError) -> dict[str, Json]:
    return {"off_deg": round(off.off_deg, 3), "off_scale": round(off.scale, 4), "off_shift": round(off.shift, 4)}
