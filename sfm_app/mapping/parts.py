"""Map a large group in parts: the steps in order, and when their model is as good as one of the whole group."""

import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from sfm_app.colmap.backend import run_in_daemon_thread, translate_errors
from sfm_app.colmap.joined_model import adjust_joined, read_placed, write_placed
from sfm_app.errors import BackendError
from sfm_app.mapping.attempt import (
    COMPLETED,
    Attempt,
    Group,
    MappingResult,
    NoModel,
    are_many_unregistered,
    best_attempt,
    extend_model,
    is_focal_accurate,
    judge_model,
)
from sfm_app.mapping.joins import (
    AcrossJoins,
    Alignment,
    Fragment,
    Join,
    align_fragments,
    find_join,
    merge_fragments,
)
from sfm_app.mapping.part_mapping import FOLDER, Part, PartResult, cut_group, map_parts
from sfm_app.numerical import FAILURES, Json, error_reason
from sfm_app.runtime.context import RunContext
from sfm_app.settings import SceneSettings
from sfm_app.types import LookAlikes, PairId, PoseGraph

logger = logging.getLogger("sfm_app")

MAPPER = "parts"


@dataclass(frozen=True, slots=True)
class PartOptions:
    """When groups are mapped in parts. Chosen by hand."""

    max_whole: int = 400
    """Photos up to which a group is mapped as a whole."""
    usual_size: int = 150
    """Photos of a part above."""
    min_size: int = 20
    """Smallest part that a user can choose: smaller ones consist of shared photos."""
    max_contradicted: float = 0.05
    """Share of contradicting inliers of F above which the whole is mapped, too."""
    min_matches: int = 16
    """Matches across a join below which these decide nothing, as of a pair."""


OPTIONS = PartOptions()


@dataclass(frozen=True, slots=True, eq=False)
class JoinedParts:
    """Models of parts and their joins."""

    parts: tuple[Part, ...]
    results: tuple[PartResult, ...]
    fragments: tuple[Fragment, ...]
    alignment: Alignment
    refused: tuple[Join, ...]
    """Joins that more matches contradict than support."""


def part_size(photos: int, options: SceneSettings) -> int:
    """Return the photos of a part; 0 where a group of `photos` photos is mapped as a whole."""
    if options.part_photos:
        size = max(OPTIONS.min_size, options.part_photos)
        return size if photos > 1.5 * size else 0
    return OPTIONS.usual_size if photos > OPTIONS.max_whole else 0


def map_in_parts(
    group: Group, mapped: PoseGraph, run: RunContext, *, stop_at_false_joins: bool = True
) -> tuple[list[MappingResult], tuple[LookAlikes, ...]]:
    """Return the results of mapping a group in parts, or else the false joins within parts, which stop the mapping.

    A group of one part gives neither. `mapped` is the pose graph with the pairs that mapping follows; it is in the
    database of the run.
    """
    parts = cut_group(group.graph, group.photos, part_size(len(group.photos), run.settings.scene))
    if len(parts) < 2:
        return [], ()
    photos = len(group.photos)
    sizes = sorted({len(part.photos) for part in parts})
    size = f"{sizes[0]} to {sizes[-1]}" if len(sizes) > 1 else f"{sizes[0]}"
    run.progress.say(f"mapping {photos} photos in {len(parts)} parts of {size}")
    try:
        results = map_parts(group, parts, mapped, run, stop_at_false_joins=stop_at_false_joins)
        joins = merge_false_joins([join for result in results for join in result.false_joins])
        if joins and stop_at_false_joins:
            return [], joins
        joined = join_parts(group, parts, results, run)
        attempts = _merge(group, joined, run)
    except (BackendError, *FAILURES) as err:  # the whole may still be mapped
        logger.info("parts were not joined", exc_info=err)
        return [NoModel(MAPPER, f"in {len(parts)} parts: failed, {error_reason(err)}")], ()
    best = best_attempt(attempts)
    if best is not None and best.photos < photos:
        completed = extend_model(group, best.model, run)
        attempts.append(judge_model(group.evidence, MAPPER, COMPLETED, completed, run))
    run.record(parts=[*run.statistics.get("parts", []), part_figures(group, joined, attempts)])
    shutil.rmtree(run.workspace.root / FOLDER, ignore_errors=True)
    return attempts, ()


def merge_false_joins(joins: Sequence[LookAlikes]) -> tuple[LookAlikes, ...]:
    """Return false joins of several parts, each pair in one of them: parts share photos, and may share a join."""
    known, merged = set[PairId](), list[LookAlikes]()
    for join in joins:
        fresh = tuple(pair for pair in join.pairs if pair not in known)
        known.update(fresh)
        merged += [replace(join, pairs=fresh)] if fresh else []
    return tuple(merged)


def parts_suffice(attempts: Sequence[MappingResult], photos: int) -> bool:
    """Return whether a model of parts makes mapping of the whole group of `photos` photos needless."""
    best = best_attempt(attempts)
    if best is None or are_many_unregistered(photos - best.photos, photos):
        return False
    inliers = sum(pair.inliers for pair in best.explained.values())
    return sum(pair.contradicted for pair in best.explained.values()) <= OPTIONS.max_contradicted * inliers


def join_parts(group: Group, parts: Sequence[Part], results: Sequence[PartResult], run: RunContext) -> JoinedParts:
    """Find the joins between the models of all parts, and a common frame without wrong ones."""
    fragments = [
        Fragment(number, frozenset(part.own), read_placed(Path(folder)))
        for number, (part, result) in enumerate(zip(parts, results, strict=True))
        for folder in result.models
    ]
    # pairs that the pose graph has dropped, as those of look-alikes, are evidence neither for a join nor against it
    sound = {pair: fit for pair, fit in group.evidence.views.fits.items() if pair in group.graph.poses}
    views = replace(group.evidence.views, fits=sound)
    across = AcrossJoins(group.evidence.matches, views, run.settings.epipolar.max_error_px)
    accepted: list[Join] = []
    refused: list[Join] = []
    for first, second in combinations(range(len(fragments)), 2):
        join = find_join(first, second, fragments)
        if join is None:
            continue
        explained, contradicted = across.count(join, fragments)
        join = replace(join, explained=explained, contradicted=contradicted)
        is_contradicted = contradicted > max(explained, OPTIONS.min_matches)
        (refused if is_contradicted else accepted).append(join)
    return JoinedParts(
        tuple(parts), tuple(results), tuple(fragments), align_fragments(fragments, accepted), tuple(refused)
    )


def _merge(group: Group, joined: JoinedParts, run: RunContext) -> list[MappingResult]:
    count = len(joined.parts)
    if not joined.fragments:
        reasons = sorted({note for result in joined.results for note in result.tried})
        return [NoModel(MAPPER, f"in {count} parts: no part has a model; {'; '.join(reasons[:3])}")]
    merged = merge_fragments(joined.fragments, joined.alignment.frames)
    database = run.workspace.database
    cameras = {photo: group.evidence.camera(photo) for photo in merged.photos.tolist()}
    free = {photo for photo, camera in cameras.items() if not (camera.is_kept or is_focal_accurate(camera))}
    with translate_errors("joining parts"), run.step("adjusting all parts together"):
        model = write_placed(database, merged)
        refined = sorted({model.images[photo].camera_id for photo in free})
        run_in_daemon_thread(lambda: adjust_joined(model, database, refined))
    how = f"in {count} parts, {len(joined.alignment.kept)} joins"
    return [judge_model(group.evidence, MAPPER, how, model, run)]


def part_figures(group: Group, joined: JoinedParts, attempts: Sequence[MappingResult]) -> dict[str, Json]:
    """Return the figures of the manifest about the parts of a group."""
    aligned = joined.alignment
    return {
        "parts": [
            {
                "photos": len(part.photos),
                "own": len(part.own),
                "first": group.evidence.matches.names(part.own[:1])[0],
                "placed": [len(one.placed.photos) for one in joined.fragments if one.part == number],
                "mapper": result.mapper,
                "tried": list(result.tried),
            }
            for number, (part, result) in enumerate(zip(joined.parts, joined.results, strict=True))
        ],
        "joins": [_join_entry(join, joined) for join in aligned.kept],
        "dropped_joins": [
            *(_join_entry(join, joined) | {"because": "contradicts other joins"} for join in aligned.dropped),
            *(_join_entry(join, joined) | {"because": "matches contradict it"} for join in joined.refused),
        ],
        "left_out": [joined.fragments[k].part for k in range(len(joined.fragments)) if k not in aligned.frames],
        "models": [one.note for one in attempts if isinstance(one, Attempt)],
    }


def _join_entry(join: Join, joined: JoinedParts) -> dict[str, Json]:
    return {
        "between": [joined.fragments[join.first].part, joined.fragments[join.second].part],
        "photos": join.photos,
        "points": join.points,
        "explained": join.explained,
        "contradicted": join.contradicted,
    }
