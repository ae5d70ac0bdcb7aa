"""Map a large group in parts, each in a process and a folder of its own, and join their models.

A model of parts may make one of the whole group needless.
"""

import json
import logging
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from itertools import combinations
from os.path import relpath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import check_written, run_in_daemon_thread, translate_errors
from sfm_app.colmap.database import write_calibrations, write_match_graph, write_pose_graph
from sfm_app.colmap.joined_model import adjust_joined, read_placed, write_placed
from sfm_app.colmap.model import posed_photo_ids, submodel
from sfm_app.colmap.worker_process import start_worker
from sfm_app.errors import BackendError
from sfm_app.files import digest_file, load_arrays, replace_atomically
from sfm_app.mapping.attempt import (
    COMPLETED,
    MAPPING,
    Attempt,
    Group,
    MappingResult,
    NoModel,
    are_many_unregistered,
    best_attempt,
    extend_model,
    is_focal_accurate,
    judge_model,
    map_group,
)
from sfm_app.mapping.cuts import Part, cut_group
from sfm_app.mapping.joins import AcrossJoins, Alignment, Fragment, Join, align_fragments, find_join, merge_fragments
from sfm_app.mapping.look_alikes import judge_places
from sfm_app.mapping.splits import sound_parts
from sfm_app.numerical import FAILURES, Json, error_reason, json_text
from sfm_app.operating_system import replace_file
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import SubWorkspace, Workspace
from sfm_app.settings import SceneSettings, Settings
from sfm_app.tasks import Task
from sfm_app.types import (
    Evidence,
    Intrinsics,
    LookAlikes,
    MatchedImage,
    MatchGraph,
    PairId,
    PoseGraph,
    RelativePose,
    ViewGraph,
)

logger = logging.getLogger("sfm_app")

MAPPER = "parts"
FOLDER, STOP = "parts", "stop"
"""Folder of the parts, and the file in it that stops them all."""


class OPTIONS:
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


@dataclass(frozen=True, slots=True)
class PartResult:
    """Models of a part."""

    models: tuple[str, ...]
    """Folders of its models, the largest first; none where it was not mapped."""
    mapper: str
    tried: tuple[str, ...]
    """Notes on all attempts, or the reason of a failure."""
    false_joins: tuple[LookAlikes, ...] = ()
    """Pairs that merge two places of the part."""


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
    """Return the results of mapping a group in parts, or else the false joins within parts, which stop the mapping."""
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


# The inputs of one part as a file, so that any process can map it.

INPUTS, RESULT = "inputs.npz", "result.json"
"""Files in the folder of a part: its inputs and its result."""
POSE_FIELDS = ("R", "t", "angle_deg", "in_front", "kind", "guided")
"""Fields of `RelativePose` with an array for all pairs; only the inliers differ in number."""


def part_of_group(group: Group, photos: Sequence[int]) -> Group:
    """Return the data of some photos of a group."""
    evidence, poses, members = group.evidence, group.graph.poses, set(photos)
    matches, fits = evidence.matches, evidence.views.fits
    pairs = [pair for pair in matches.matches if members.issuperset(pair)]
    images = {photo: matches.images[photo] for photo in photos}
    names = {image.name: evidence.camera_name(photo) for photo, image in images.items()}
    cameras = {name: camera for name, camera in evidence.intrinsics.cameras.items() if name in set(names.values())}
    own = Evidence(
        MatchGraph(
            images,
            {photo: matches.keypoints[photo] for photo in photos},
            {pair: matches.matches[pair] for pair in pairs},
        ),
        ViewGraph({pair: fits[pair] for pair in pairs if pair in fits}, {}),
        Intrinsics(cameras, names, {photo: image.name for photo, image in images.items()}),
    )
    graph = PoseGraph({pair: poses[pair] for pair in pairs if pair in poses}, {}, (tuple(photos),))
    return Group(tuple(photos), own, graph)


@dataclass(frozen=True, slots=True, eq=False)
class PartInputs:
    """Inputs for mapping a part."""

    part: Group
    mapped: frozenset[PairId]
    """Pairs of the pose graph that mapping follows."""
    settings: Settings
    stop_at_false_joins: bool
    """Whether a false join ends the mapping of the part, because all parts are then mapped again."""


def write_inputs(path: Path, inputs: PartInputs) -> None:
    """Write the inputs of a part atomically."""
    part, evidence = inputs.part, inputs.part.evidence
    known = {
        "photos": list(part.photos),
        # frames, times and claims of photos do not matter to mapping
        "images": [
            asdict(replace(image, gps=None, shown=None, prior=None)) for image in evidence.matches.images.values()
        ],
        "intrinsics": evidence.intrinsics.to_dict(),
        "settings": inputs.settings.model_dump(mode="json"),
        "asked": inputs.stop_at_false_joins,
    }
    matches, poses = evidence.matches, part.graph.poses
    arrays: dict[str, NDArray[Any]] = {"known": np.array(json_text(known))}
    arrays["mapped"] = np.array(sorted(inputs.mapped), np.int64).reshape(-1, 2)
    arrays |= {f"keypoints_{photo}": x.astype(np.float64) for photo, x in matches.keypoints.items()}
    arrays |= {f"matches_{a}_{b}": rows.astype(np.uint32) for (a, b), rows in matches.matches.items()}
    arrays |= {f"view_{name}": array for name, array in evidence.views.to_arrays().items()}
    arrays |= {f"inliers_{a}_{b}": pose.inliers for (a, b), pose in poses.items()}
    arrays |= {f"pose_{name}": np.array([getattr(pose, name) for pose in poses.values()]) for name in POSE_FIELDS}
    with replace_atomically(path) as beside, beside.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def read_inputs(path: Path) -> PartInputs:
    """Read back what `write_inputs` wrote."""
    arrays = load_arrays(path)
    known = json.loads(str(arrays["known"]))
    images = {image["id"]: MatchedImage(**image) for image in known["images"]}
    keypoints = {photo: x for (photo,), x in _numbered_arrays(arrays, "keypoints").items()}
    matches = {(a, b): rows for (a, b), rows in _numbered_arrays(arrays, "matches").items()}
    views = {name.removeprefix("view_"): array for name, array in arrays.items() if name.startswith("view_")}
    intrinsics = Intrinsics.from_dict(known["intrinsics"])
    evidence = Evidence(MatchGraph(images, keypoints, matches), ViewGraph.from_arrays(views), intrinsics)
    R, t, *others = (arrays[f"pose_{name}"] for name in POSE_FIELDS)
    inliers = _numbered_arrays(arrays, "inliers")
    poses = map(RelativePose, R, t, inliers.values(), *(values.tolist() for values in others))
    photos = tuple(known["photos"])
    graph = PoseGraph({(a, b): pose for (a, b), pose in zip(inliers, poses, strict=True)}, {}, (photos,))
    mapped = frozenset((int(a), int(b)) for a, b in arrays["mapped"])
    return PartInputs(Group(photos, evidence, graph), mapped, Settings.from_mapping(known["settings"]), known["asked"])


def _numbered_arrays(arrays: Mapping[str, NDArray[Any]], kind: str) -> dict[tuple[int, ...], NDArray[Any]]:
    """Return the arrays of a kind, by the photo or the pair in their names."""
    names = [name for name in arrays if name.startswith(f"{kind}_")]
    return {tuple(map(int, name.split("_")[1:])): arrays[name] for name in names}


# One process per part.


def map_parts(
    group: Group, parts: Sequence[Part], mapped: PoseGraph, run: RunContext, *, stop_at_false_joins: bool
) -> list[PartResult]:
    """Map parts side by side, except those that a killed run has finished; failed ones have no models."""
    place = run.workspace.root / FOLDER
    (place / STOP).unlink(missing_ok=True)
    folders = list[Path]()  # small, since the inputs in them are files that every worker can read
    for part in parts:
        members = part_of_group(group, part.photos)
        followed = frozenset(pair for pair in members.graph.poses if pair in mapped.poses)
        write_inputs(place / INPUTS, PartInputs(members, followed, run.settings, stop_at_false_joins))
        folders.append(place / digest_file(place / INPUTS)[:16])
        folders[-1].mkdir(exist_ok=True)
        replace_file(place / INPUTS, folders[-1] / INPUTS)
    try:
        return run.map(Task(map_part, run.workspace.photos), folders, f"mapping {len(parts)} parts")
    except BaseException:  # also Ctrl-C: the processes end when they see the file
        (place / STOP).touch()
        raise


def map_part(photos: Path, folder: Path) -> PartResult:
    """Map the part in a folder in a separate process, and wait for it; depends on nothing but the folders."""
    if not (folder / RESULT).exists():
        try:
            with start_worker(partial(_work, photos, folder)) as process:
                while not process.has_ended(0.2):
                    if (folder.parent / STOP).exists():
                        return PartResult((), "", ("stopped",))
                process.check("mapping a part")
        except BackendError as err:  # its photos are left to the other parts
            logger.info("a part was not mapped", exc_info=err)
            return PartResult((), "", (f"failed: {err}",))
    result = json.loads((folder / RESULT).read_text(encoding="utf-8"))
    return PartResult(
        tuple(str(folder / name) for name in result["models"]),
        result["mapper"],
        tuple(result["tried"]),
        tuple(LookAlikes(tuple(map(tuple, join["pairs"])), join["missing"]) for join in result["false_joins"]),
    )


def _work(photos: Path, folder: Path) -> None:
    """Map the part in a folder, and write its models and notes beside its inputs."""
    inputs = read_inputs(folder / INPUTS)
    judge = cache(lambda attempt: judge_places([attempt])[0])
    enough = MAPPING.enough_share * len(inputs.part.photos)
    # a worker that was cut off from a cluster may still be at the same part
    with tempfile.TemporaryDirectory(dir=folder, prefix="mapping-") as own, make_executor(1) as executor:
        place = SubWorkspace(Workspace(photos.parent), relpath(own, photos.parent))
        part, graph = inputs.part, inputs.part.graph
        poses = {pair: pose for pair, pose in graph.poses.items() if pair in inputs.mapped}
        with translate_errors("entering the photos of a part"):
            write_match_graph(place.database, part.evidence.matches)
            write_calibrations(place.database, part.evidence.matches, part.evidence.intrinsics)
            write_pose_graph(place.database, part.evidence.matches, PoseGraph(poses, {}, graph.groups))
        run = RunContext(inputs.settings, place, load_plugins(installed=False), executor, workers=1)
        attempts = map_group(
            inputs.part, run, lambda one: inputs.stop_at_false_joins and one.photos >= enough and bool(judge(one))
        )
    if (folder / RESULT).exists():
        return
    best = best_attempt(attempts)
    result = {
        "models": [] if best is None else _write_models(best, folder),
        "mapper": "" if best is None else best.mapper,
        "tried": [one.note for one in attempts],
        "false_joins": [] if best is None else [asdict(join) for join in judge(best)],
    }
    with replace_atomically(folder / RESULT) as path:
        path.write_text(json.dumps(result), encoding="utf-8", newline="\n")


def _write_models(best: Attempt, folder: Path) -> list[str]:
    parts = sound_parts(best.explained, posed_photo_ids(best.model))
    pieces = [photos for photos in parts if len(photos) >= 3]  # nothing determines the scale of two photos
    names = []
    for number, photos in enumerate(pieces):
        names.append(f"model-{number}")
        target = folder / names[-1]
        target.mkdir(exist_ok=True)
        with translate_errors("writing the model of a part"):
            submodel(best.model, photos).write(target)
            check_written(*target.iterdir())
    return names
