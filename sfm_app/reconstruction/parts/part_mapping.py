"""Map the parts of a group side by side, each in a process and a folder of its own."""

import json
import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sfm_app.colmap.processes.worker_process import MappingTask, start_worker
from sfm_app.errors import BackendError
from sfm_app.hashing import digest_file
from sfm_app.operating_system import replace_file
from sfm_app.reconstruction.mapping_runs import Group
from sfm_app.reconstruction.parts.cut import Part
from sfm_app.reconstruction.parts.part_files import (
    INPUTS,
    RESULT,
    PartInputs,
    joins_from_plain,
    pairs_of_parts,
    part_of_group,
    write_inputs,
)
from sfm_app.runtime.context import RunContext
from sfm_app.tasks import Task
from sfm_app.types import LookAlikes, PoseGraph

logger = logging.getLogger("sfm_app")

FOLDER, STOP = "parts", "stop"
"""Folder of the parts, and the file in it that stops them all."""
POLL_S = 0.2


@dataclass(frozen=True, slots=True)
class PartTask:
    """One part to map: small, since its inputs are files that every worker can read."""

    folder: str
    """Holds the inputs, and gets the models."""
    photos: str
    """Folder with the photos; COLMAP requires it."""


@dataclass(frozen=True, slots=True)
class PartResult:
    """What became of a part."""

    models: tuple[str, ...]
    """Folders of its models, the largest first; none where it was not mapped."""
    mapper: str
    tried: tuple[str, ...]
    """Notes on all attempts, for people; the reason of a failure."""
    false_joins: tuple[LookAlikes, ...] = ()
    """Pairs that hold one place of the part on top of another."""


def map_parts(
    group: Group, parts: Sequence[Part], mapped: PoseGraph, run: RunContext, *, asked: bool
) -> list[PartResult]:
    """Map parts, as many at once as there are workers; one that fails is a result without models.

    Parts that a killed run has finished are not mapped again.

    Args:
        group: connected photos, with their matches, geometry and cameras.
        parts: of its photos.
        mapped: the pose graph with the pairs that mapping follows.
        run: the run.
        asked: whether false joins within parts end the pass.
    """
    place = run.workspace.root / FOLDER
    (place / STOP).unlink(missing_ok=True)
    within = pairs_of_parts(group.matches.matches, [part.photos for part in parts])
    members = (part_of_group(group, part.photos, pairs) for part, pairs in zip(parts, within, strict=True))
    tasks = [_prepare_part(one, mapped, place, run, asked=asked) for one in members]
    try:
        return run.map(Task(map_part), tasks, f"mapping {len(parts)} parts")
    except BaseException:  # also Ctrl-C: the processes end when they see the file
        (place / STOP).touch()
        raise


def _prepare_part(members: Group, mapped: PoseGraph, place: Path, run: RunContext, *, asked: bool) -> PartTask:
    """Write the inputs of a part, in a folder that is called after what they are."""
    beside = place / INPUTS
    followed = frozenset(pair for pair in members.graph.poses if pair in mapped.poses)
    write_inputs(beside, PartInputs(members, followed, run.settings, asked))
    folder = place / digest_file(beside)[:16]
    folder.mkdir(exist_ok=True)
    replace_file(beside, folder / INPUTS)
    return PartTask(str(folder), str(run.workspace.photos))


def map_part(task: PartTask) -> PartResult:
    """Map one part in a process of its own, and wait for it. Depends on nothing but the task.

    Args:
        task: names the folder of the part.
    """
    folder = Path(task.folder)
    if not (folder / RESULT).exists():
        work: MappingTask = {"scratch": task.folder, "photos": task.photos, "seed": 0}
        try:
            with start_worker("sfm_app.reconstruction.parts.part_process", work) as process:
                while not process.has_ended(POLL_S):
                    if (folder.parent / STOP).exists():
                        return PartResult((), "", ("stopped",))
                process.check("mapping a part")
        except BackendError as err:  # its photos are left to the other parts
            logger.info("a part was not mapped", exc_info=err)
            return PartResult((), "", (f"failed: {err}",))
    known = json.loads((folder / RESULT).read_text(encoding="utf-8"))
    return PartResult(
        tuple(str(folder / name) for name in known["models"]),
        known["mapper"],
        tuple(known["tried"]),
        joins_from_plain(known["false_joins"]),
    )


def remove_parts(run: RunContext) -> None:
    """Remove the folders of all parts."""
    shutil.rmtree(run.workspace.root / FOLDER, ignore_errors=True)
